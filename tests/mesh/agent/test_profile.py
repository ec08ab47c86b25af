"""The profile of a robot: from its settings and its model, by what it does, and how others see it."""

from __future__ import annotations

import asyncio
import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh import Agent, ConfigurationError, Settings
from mesh.agent._profile import INTERVAL
from mesh.agent.handlers import Job, JobFailed
from mesh.watching.robots import Robot, RobotDirectory
from schemas import Empty, ProfileKey, Signer, cid_of_bytes
from schemas.profiles import PROFILE_LIMITS, Handover, Profile
from tests.mesh.agent.test_own_model import DRIVE, Move, driving, file, saved
from tests.support.market import MODEL, offering
from tests.support.raising import raises_with
from tests.support.waiting import until, until_answered, until_found, until_heard

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from mesh.testing import Market

__all__ = ["file"]

PNG = b"\x89PNG\r\n\x1a\n and more"
DRIVING = [("/drive", Move(1.0)), ("/stop", Empty())]
LIFT: dict[str, Any] = {"name": "Lift 1", "about": "Lifts 1.2 t.", "place": "Hall 3"}


async def profile_of(robot: Agent, asker: Agent) -> Profile:
    """What a robot says to another agent now."""
    await until_answered(asker.network.session, str(ProfileKey(robot.address)))
    found = await RobotDirectory(asker.network.session, asker.channel).find(robot.address)
    assert found is not None
    return found


async def test_a_robot_that_ends_while_its_profile_changes_ends(
    market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`asyncio.wait_for` before Python 3.12 loses a cancellation that comes together with what it waits for."""
    monkeypatch.setattr("mesh.agent._profile.INTERVAL", 0.0)
    async with market.robot(offering(Agent(MODEL))) as robot:
        profile = robot.runtime.profile
        watching = asyncio.create_task(profile.run())
        await until(lambda: len(profile._changed._waiters) == 1)
        profile.changed()
        watching.cancel()
        await asyncio.wait([watching], timeout=10)
        assert watching.cancelled()


async def test_a_robot_says_what_its_settings_and_its_model_say(market: Market, file: Path) -> None:
    picture, person = saved(file.with_name("lift.png"), PNG), await market.person()
    async with market.robot(driving(Agent(file, settings=Settings(picture=str(picture), **LIFT)))) as robot:
        said = await profile_of(robot, person)
        assert {name: getattr(said, name) for name in LIFT} == LIFT
        assert (said.agent, said.model, said.price) == (robot.address, DRIVE.cid, "5 XRT")
        assert (said.state, said.queue, said.wait) == ("idle", 0, 0)
        assert abs(said.time - time.time()) < 60
        assert said.picture == cid_of_bytes(PNG)
        assert robot.parts.store.has(said.picture)
        (seen,) = await person.robots(DRIVE.cid)
        assert (str(seen), seen.address, seen.price) == ("Lift 1", robot.address, "5 XRT")
        assert seen.paid is not None
        assert await person.robots(MODEL) == []


async def test_a_robot_says_what_it_reads_just_now(market: Market) -> None:
    person = await market.person()
    async with market.robot(offering(Agent(MODEL))) as robot:
        for volts in (11.5, 12.5):
            robot.publish("/battery", volts)
        for topic, value in (("/state", "\x1b[2Jdocked" + "x" * 100), ("/pose", {"x": 1}), ("/picture", b"x" * 9000)):
            robot.publish(topic, value)
        robot.publish("/one/too/many", 1)
        await profile_of(robot, person)
        (seen,) = await person.robots()
        assert seen.readings == {
            "/battery": "12.5",
            "/state": "\ufffd[2Jdocked" + "x" * 70,
            "/pose": '{"x": 1}',
            "/picture": "9,000 bytes",
        }


async def test_an_agent_that_only_orders_is_no_robot(market: Market) -> None:
    async with market.robot(offering(Agent(MODEL))) as robot, market.robot(Agent(settings=Settings(name="Ann"))) as ann:
        await profile_of(robot, ann)
        assert [one.address for one in await ann.robots()] == [robot.address]


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"name": "n" * 81}, "profile-invalid"),
        ({"about": "\x1b[2J"}, "profile-invalid"),
        ({"picture": "lift.png"}, "picture-unusable"),
        ({"picture": "text"}, "picture-unusable"),
        ({"picture": "large"}, "picture-unusable"),
    ],
)
async def test_what_nobody_could_show_ends_the_start(
    market: Market, tmp_path: Path, settings: dict[str, Any], code: str
) -> None:
    files = {"text": b"a text", "large": PNG + bytes(PROFILE_LIMITS.picture)}
    if content := files.get(settings.get("picture", "")):
        settings = {"picture": str(saved(tmp_path / "picture", content))}
    with raises_with(ConfigurationError, code=code):
        async with market.robot(offering(Agent(MODEL, settings=Settings(**settings)))):
            pass


async def test_a_job_changes_the_state_and_the_queue(market: Market, file: Path) -> None:
    """Both jobs are paid or refunded in the end, and counted for those who ask."""
    go_on, robot, person = asyncio.Event(), offering(Agent(file)), await market.person()

    @robot.on("/drive")
    async def drive(job: Job, move: Move) -> None: ...

    @robot.on("/stop")
    async def stop(job: Job, nothing: Empty) -> None:
        await go_on.wait()
        if job.liability.cost == 2:
            raise JobFailed("it is broken")

    put: list[str] = []

    def hear(sample: zenoh.Sample) -> None:
        put.append(Profile.decode(sample.payload.to_bytes()).state)

    async with market.robot(robot):
        subscriber = person.network.session.declare_subscriber(str(ProfileKey(robot.address)), hear)
        await until_heard(robot.network.session, str(ProfileKey(robot.address)))
        contracts = [await market.demand(robot, DRIVING, by=person, cost=cost) for cost in (1, 2)]
        directory = RobotDirectory(person.network.session, person.channel)

        async def is_busy() -> bool:
            (one,) = await directory.present()
            return (one.state, one.queue, one.wait) == ("working", 1, 3)  # 2 s each, half of one is done

        await until_found(is_busy, what="the second job")
        await until(lambda: put[-1:] == ["working"], what="the word that it works")  # at most one a second
        go_on.set()
        outcomes = [await contract.outcome() for contract in contracts]
        assert [outcome.success for outcome in outcomes] == [True, False]

        async def is_idle() -> bool:
            (one,) = await directory.present()
            return (one.state, one.queue, one.wait) == ("idle", 0, 0)

        await until_found(is_idle, what="an idle robot")
        await until(lambda: put[-1] == "idle", what="the word that it is idle")
        subscriber.undeclare()  # type: ignore[no-untyped-call]
        assert (await person.chain.liabilities.outcomes(blocks=50_000, most=500))[robot.address] == (1, 1)
        (seen,) = await directory.count(person.chain, await directory.present())
        assert (seen.paid, seen.refunded) == (1, 1)
        last = await person.chain.liabilities.outcomes(blocks=50_000, most=1)
        assert last == {robot.address: (0, 1)}


async def test_a_robot_that_does_several_jobs_at_once_says_when_its_first_place_is_free(
    market: Market, file: Path
) -> None:
    """Two jobs of 2 s are half done, and one waits: it takes the first place that is free, the next job the second."""
    go_on, robot = asyncio.Event(), offering(Agent(file, parallel=2))

    @robot.on("/drive")
    async def drive(job: Job, move: Move) -> None: ...

    @robot.on("/stop")
    async def stop(job: Job, nothing: Empty) -> None:
        await go_on.wait()

    waits = [(0, 0), (0, 1), (1, 1), (2, 3)]
    async with market.robot(robot):
        contracts = []
        for cost, expected in enumerate(waits, 1):
            contracts.append(await market.demand(robot, DRIVING, cost=cost))

            async def is_so(expected: tuple[int, int] = expected) -> bool:
                return await robot.runtime.profile.queue() == expected

            await until_found(is_so, what=f"{expected}")
        go_on.set()
        for contract in contracts:
            assert (await contract.outcome()).success


async def test_a_robot_that_is_stopped_or_closed_says_so(market: Market) -> None:
    person = await market.person()
    async with market.robot(offering(Agent(MODEL))) as robot:
        await robot.control(paused=True, stop="it smokes")
        assert (await profile_of(robot, person)).state == "stopped"
        await robot.control(release=True)
        assert (await profile_of(robot, person)).state == "closed"
        await robot.control(paused=False)
        assert (await profile_of(robot, person)).state == "idle"


async def test_a_change_is_put_once_a_second_at_most(market: Market) -> None:
    heard: list[tuple[float, Profile]] = []

    def hear(sample: zenoh.Sample) -> None:
        heard.append((time.monotonic(), Profile.decode(sample.payload.to_bytes())))

    person, account = await market.person(), market.chain.new_account()
    key = str(ProfileKey(account.address))
    subscriber = person.network.session.declare_subscriber(key, hear)
    async with market.robot(offering(Agent(MODEL, account=account))) as robot:
        await until_heard(robot.network.session, key)
        for number in range(50):
            await robot.control(paused=bool(number % 2))
            await asyncio.sleep(0.02)
        await until(lambda: bool(heard) and heard[-1][1].state == "closed", what="the last state")
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert all(profile.is_signed for _, profile in heard)
    assert all(later - earlier > INTERVAL / 2 for (earlier, _), (later, _) in pairwise(heard))
    assert len(heard) <= 4


async def test_an_agent_without_an_account_lists_robots_without_records(market: Market) -> None:
    async with market.robot(offering(Agent(MODEL, settings=Settings(name="Lift")))) as robot:
        await profile_of(robot, await market.person())
        async with Agent(MODEL, settings=market.settings("watcher")) as watcher:
            (seen,) = await watcher.robots()
    assert isinstance(seen, Robot)
    assert (str(seen), seen.paid, seen.refunded) == ("Lift", None, None)


def test_a_robot_has_all_that_its_profile_says() -> None:
    names = {"agent", "signature", "handovers"} ^ {field.name for field in msgspec.structs.fields(Profile)}
    assert names | {"address", "formerly", "paid", "refunded"} == {
        field.name for field in msgspec.structs.fields(Robot)
    }


def test_only_keys_that_have_signed_it_are_earlier_ones_of_a_robot() -> None:
    first, second, now, stranger = (Signer(bytes([number]) * 32) for number in range(1, 5))
    handed = Handover(agent=first.address, successor=second.address, time=1).signed_by(first)
    again = Handover(agent=second.address, successor=now.address, time=2).signed_by(second)
    profile = Profile(agent=now.address, handovers=(handed, again), time=3).signed_by(now)
    assert Profile.decode(profile.encode()).predecessors == (second.address, first.address)
    forged = Handover(agent=first.address, successor=now.address, time=1).signed_by(stranger)
    for wrong in ((handed,), (again, handed), (forged,)):
        assert Profile(agent=now.address, handovers=wrong, time=3).predecessors == ()
    assert Profile(agent=now.address, handovers=(forged, again), time=3).predecessors == (second.address,)


async def test_the_record_of_an_earlier_key_counts_for_one_robot_only(market: Market) -> None:
    class Counted:
        class liabilities:  # noqa: N801
            @staticmethod
            async def outcomes(**limits: int) -> dict[str, tuple[int, int]]:
                return {"old": (3, 1), "new": (2, 0)}

    person = await market.person()
    directory = RobotDirectory(person.network.session, person.channel)
    moved, stranger = robot_seen("new", "old"), robot_seen("stranger", "old")
    (counted,) = await directory.count(Counted(), [moved])  # type: ignore[arg-type]
    assert (counted.paid, counted.refunded) == (5, 1)
    both = await directory.count(Counted(), [moved, stranger])  # type: ignore[arg-type]
    assert [(one.paid, one.refunded) for one in both] == [(2, 0), (0, 0)]
    still = await directory.count(Counted(), [moved, robot_seen("old")])  # type: ignore[arg-type]
    assert [(one.paid, one.refunded) for one in still] == [(2, 0), (3, 1)]


def robot_seen(address: str, *formerly: str) -> Robot:
    texts: Any = dict.fromkeys(("model", "name", "about", "picture", "place", "price"), "")
    return Robot(address=address, formerly=formerly, state="idle", queue=0, wait=0, readings={}, time=0, **texts)

"""`aira demand --retry`: a job that one robot hands back is done by another, under one number; how it is called off."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import sys
from typing import TYPE_CHECKING, Final

import pytest

from tests.mesh.cli.test_choosing import SPEAKER, Typed
from tests.support.cli.site import Site
from tests.support.commands import AIRA, Serving, aira

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

LIFT: Final = """
import asyncio, sys
from pathlib import Path
from mesh import Agent, JobFailed

agent = Agent(Path(sys.argv[1]))
price, what = sys.argv[2:]

@agent.on_quote
def quote(request) -> str:
    return price

@agent.on_demand
async def offer(demand) -> None:
    if what == "decides slowly":
        print("asked", flush=True)
        await asyncio.sleep(600)
    await agent.offer(demand)

@agent.on("/say")
async def say(job, word: str) -> None:
    print("began", flush=True)
    if what == "works":
        return
    if what == "hands back":
        raise JobFailed("battery low", code="battery-low")
    await asyncio.sleep(600)

agent.run()
"""
"""A robot: its model's file, its price, and what it does."""


class Lifts:
    """A cheap and a dear robot, a provider and a person, each as processes of their own."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.model, self._program = site.folder / "speaker.json", site.folder / "lift.py"
        self.model.write_bytes(SPEAKER.encode())
        self._program.write_text(LIFT)
        self.cheap, self.dear = (self._short(role, name) for role, name in (("robot", "Lift 1"), ("rival", "Lift 2")))

    def _short(self, role: str, name: str) -> str:
        address = self.site.address(role)
        return f"{name} ({address[:6]}…{address[-4:]})"

    def robots(self, cheap: str, dear: str) -> tuple[Serving, Serving]:
        """`Lift 1` for 4 wn and `Lift 2` for 9 wn, and what they do."""
        return self._robot("robot", "Lift 1", "4 wn", cheap), self._robot("rival", "Lift 2", "9 wn", dear)

    def _robot(self, role: str, name: str, *words: str) -> Serving:
        variables = self.site.variables(role, name=name, data_dir=str(self.site.folder / role), playback="at-once")
        return Serving(sys.executable, self._program, self.model, *words, says="account 0x", variables=variables)

    def words(self, *options: str) -> tuple[str, ...]:
        given = ("--model", str(self.model), "--objective", str(self.site.job("up")), "--max-cost", "9wn")
        return ("demand", *given, *options)

    def demand(self, *options: str, says: str) -> Serving:
        """`aira demand` as a process, not yet started."""
        return Serving(*AIRA, *self.words(*options), says=says, variables=self.site.variables("person"))

    async def ends(self) -> list[tuple[str, bool, bool]]:
        """Of each contract of the person: the robot, whether it has ended, whether it was paid."""
        async with self.site.chain("person") as chain:
            found = await chain.liabilities.list(promisee=self.site.address("person"))
        return [(one.promisor, one.is_finalized, one.is_success) for one in found]

    async def balance(self) -> int:
        async with self.site.chain("person") as chain:
            return await chain.tokens.balance()


@pytest.fixture
async def lifts(anvil: Anvil, router: EmbeddedRouter, tmp_path: Path) -> Lifts:
    return Lifts(await Site.found(anvil.url, anvil.private_keys, router.endpoint, tmp_path))


async def test_what_the_cheaper_robot_hands_back_the_other_does_under_one_number(lifts: Lifts) -> None:
    cheap, dear = lifts.robots("hands back", "works")
    before = await lifts.balance()
    async with lifts.site.provider(), cheap, dear:
        words = lifts.words("--robot", "cheapest", "--retry", "2")
        done = await asyncio.to_thread(aira, *words, **lifts.site.variables("person"))
        assert done.returncode == 0, done.stdout + done.stderr
        assert before - await lifts.balance() == 9
        ends = await lifts.ends()
    assert sorted(paid for _, _, paid in ends) == [False, True]
    posted = re.findall(r"posted ([0-9a-f]{64}), (.+?) for (.+?), valid until block ([\d,]+)", done.stdout)
    assert [(price, who) for _, price, who, _ in posted] == [
        ("0.000000004 XRT", lifts.cheap),
        ("0.000000009 XRT", lifts.dear),
    ]
    assert int(posted[1][3].replace(",", "")) <= int(posted[0][3].replace(",", ""))
    job = f"job {posted[0][0][:16]}: "
    assert [line.removeprefix(job) for line in done.stdout.splitlines() if line.startswith("job ")] == [
        "3 attempts at most until then",
        f"{lifts.cheap} did not do it: battery low (battery-low); ordering again, attempt 2 of 3",
        "done in 2 attempts",
    ]


async def test_the_command_fails_with_all_reasons_when_no_robot_is_left(lifts: Lifts) -> None:
    cheap, dear = lifts.robots("hands back", "hands back")
    before = await lifts.balance()
    async with lifts.site.provider(), cheap, dear:
        words = lifts.words("--robot", "cheapest", "--retry", "9", "--json")
        done = await asyncio.to_thread(aira, *words, **lifts.site.variables("person"))
        assert done.returncode == 1
        assert await lifts.balance() == before
    *seen, end = map(json.loads, done.stdout.splitlines())
    posted = [one for one in seen if one["kind"] == "posted"]
    assert {one["number"] for one in (*posted, end)} == {posted[0]["order"][:16]}
    (again,) = [one for one in seen if one["kind"] == "again"]
    assert (again["name"], again["attempt"], again["attempts"], again["code"]) == ("Lift 1", 2, 10, "battery-low")
    (given_up,) = [one for one in seen if one["kind"] == "given-up"]
    assert given_up["code"] == "no-robot-fits"
    assert [(one["robot"], one["reason"]) for one in end["earlier"]] == [(lifts.site.address("robot"), "battery low")]
    assert (end["robot"], end["success"], end["code"]) == (lifts.site.address("rival"), False, "battery-low")


async def test_a_robot_that_begins_too_late_is_stopped_and_another_does_the_job(lifts: Lifts) -> None:
    cheap, dear = lifts.robots("hangs", "works")
    busy = lifts.demand("--cost", "4wn", "--robot", "Lift 1", "--existing", "new", says="contract 0x")
    async with lifts.site.provider(), cheap, dear:
        await asyncio.to_thread(busy.start)
        await asyncio.to_thread(cheap.wait_until_said, "began")
        await asyncio.to_thread(busy.kill)
        within = ("--retry", "1", "--start-within", "7", "--existing", "new")  # its quote says five seconds
        words = lifts.words("--robot", "cheapest", *within)
        done = await asyncio.to_thread(aira, *words, **lifts.site.variables("person"))
        assert done.returncode == 0, done.stdout + done.stderr
    assert f"robot {lifts.cheap} has not begun within 7 s; stopping it\n" in done.stdout
    assert "; ordering again, attempt 2 of 2\n" in done.stdout
    assert f" with {lifts.dear}\n" in done.stdout


async def test_ctrl_c_twice_in_a_later_attempt_stops_the_robot_and_no_other_follows(lifts: Lifts) -> None:
    cheap, dear = lifts.robots("hands back", "hangs")
    words = lifts.words("--robot", "cheapest", "--retry", "5")
    async with lifts.site.provider(), cheap, dear:
        person = Typed(*words, variables=lifts.site.variables("person"))
        await person.start()
        await asyncio.to_thread(dear.wait_until_said, "began")
        await person.until(f" with {lifts.dear}")
        person.press_ctrl_c()
        await person.until("press Ctrl-C again within 5 seconds to stop the robot")
        person.press_ctrl_c()
        assert await person.end() == 1
        assert [ended for _, ended, _ in await lifts.ends()] == [True, True]
    assert "stopped by the customer: the customer pressed Ctrl-C (stopped)" in person.shown
    assert person.shown.count("ordering again") == 1
    assert "not done in 2 attempts" in person.shown


async def test_ctrl_c_while_a_robot_is_asked_for_another_attempt_leaves_no_order(lifts: Lifts) -> None:
    cheap, dear = lifts.robots("hands back", "decides slowly")
    waiting = lifts.demand("--robot", "cheapest", "--retry", "1", says="contract 0x")
    async with lifts.site.provider(), cheap, dear:
        await asyncio.to_thread(waiting.start)
        await asyncio.to_thread(dear.wait_until_said, "asked")
        code, _ = await asyncio.to_thread(waiting.end, signal.SIGINT)
        listed = await asyncio.to_thread(aira, "order", "list", "--json", **lifts.site.variables("person"))
        assert (code, json.loads(listed.stdout)) == (130, [])
    assert "not ordered again when this command has ended" in waiting.log()
    assert "the contract goes on" not in waiting.log()

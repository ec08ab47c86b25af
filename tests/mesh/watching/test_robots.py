"""The robots that are present: whose word counts, names, and what strangers can do to those who ask."""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.errors import InputError, InvalidAddress
from mesh.watching import RobotDirectory, robot_address
from mesh.watching.market import QUERY_LIMITS
from mesh.watching.robots import PROFILE_LOOKUP_LIMITS
from schemas import ProfileKey, Signer
from schemas.address import shortened
from schemas.profiles import Profile
from tests.mesh.watching.test_presence import Meeting, answering, meeting
from tests.support.orders import OBJECTIVE, PERSON, ROBOT, STRANGER
from tests.support.raising import raises_with
from tests.support.waiting import until_answered

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zenoh

__all__ = ["meeting"]


def profile(signer: Signer = ROBOT, **fields: Any) -> Profile:
    facts: dict[str, Any] = {"agent": signer.address, "time": int(time.time()), "name": "Lift"}
    return Profile(**facts | fields).signed_by(signer)


@contextmanager
def answering_with(meeting: Meeting, key: str, *answers: bytes) -> Iterator[None]:
    """Several processes that answer on one key."""
    with ExitStack() as stack:
        for answer in answers:
            stack.enter_context(answering(meeting.writer.session, key, answer))
        yield


@contextmanager
def robots(meeting: Meeting, *profiles: Profile) -> Iterator[None]:
    """Robots that are present, and answer with these profiles."""
    with ExitStack() as stack:
        for one in profiles:
            meeting.shown.announce("agent", one.agent)
            stack.enter_context(answering(meeting.writer.session, str(ProfileKey(one.agent)), one.encode()))
        yield


async def until_there(meeting: Meeting, *signers: Signer) -> RobotDirectory:
    for signer in signers:
        await until_answered(meeting.session, str(ProfileKey(signer.address)))
    return RobotDirectory(meeting.session, meeting.seen)


async def test_present_robots_are_listed_by_name(meeting: Meeting) -> None:
    meeting.shown.announce("agent", STRANGER.address)  # which says nothing of itself
    with robots(meeting, profile(name="zebra", price="5 XRT", queue=2), profile(PERSON, name="Arm", model=OBJECTIVE)):
        directory = await until_there(meeting, ROBOT, PERSON)
        arm, zebra = await directory.present()
        assert (arm.address, str(arm), arm.model) == (PERSON.address, "Arm", OBJECTIVE)
        assert (zebra.address, zebra.price, zebra.queue, zebra.state) == (ROBOT.address, "5 XRT", 2, "idle")
        assert (zebra.paid, zebra.refunded) == (None, None)
        assert [robot.name for robot in await directory.present(OBJECTIVE)] == ["Arm"]
        assert directory.name(ROBOT.address) == "zebra"


async def test_a_robot_without_a_name_is_its_short_address(meeting: Meeting) -> None:
    with robots(meeting, profile(name="")):
        (robot,) = await (await until_there(meeting, ROBOT)).present()
    assert str(robot) == shortened(ROBOT.address)


async def test_only_the_latest_word_of_the_robot_itself_counts(meeting: Meeting) -> None:
    now = int(time.time())
    forged = msgspec.structs.replace(profile(name="forged", time=now + 3), signature=profile(PERSON).signature)
    said = (
        profile(name="old", time=now - 60),
        profile(name="now", time=now),
        profile(PERSON, name="another's", time=now + 1),
        forged,
        profile(name="of tomorrow", time=now + int(QUERY_LIMITS.clock_error) + 100),
    )
    with answering_with(meeting, str(ProfileKey(ROBOT.address)), *(one.encode() for one in said), b"{}", b"x" * 9000):
        found = await (await until_there(meeting, ROBOT)).find(ROBOT.address)
    assert found is not None
    assert found.name == "now"


async def test_what_was_signed_long_ago_does_not_count(meeting: Meeting) -> None:
    with robots(meeting, profile(time=int(time.time() - QUERY_LIMITS.oldest) - 10)):
        assert await (await until_there(meeting, ROBOT)).present() == []


async def test_a_profile_is_asked_for_once_a_minute(meeting: Meeting) -> None:
    with robots(meeting, profile()):
        directory = await until_there(meeting, ROBOT)
        first = await directory.find(ROBOT.address)
    assert await directory.find(ROBOT.address) is first is not None


async def test_who_is_silent_takes_a_tenth_of_the_time(meeting: Meeting) -> None:
    held: list[zenoh.Query] = []
    key = str(ProfileKey(STRANGER.address))
    queryable = meeting.writer.session.declare_queryable(key, held.append)
    with robots(meeting, profile()):
        directory = await until_there(meeting, ROBOT)
        while not held:  # until the stranger's declaration has come
            await asyncio.wait_for(RobotDirectory(meeting.session, meeting.seen).find(STRANGER.address), 30)
        assert await directory.find(STRANGER.address) is None
        begun = time.monotonic()
        assert await directory.find(ROBOT.address) is None  # it rests
        assert time.monotonic() - begun < PROFILE_LOOKUP_LIMITS.timeout
        assert [robot.address for robot in await directory.present()] == [ROBOT.address]
    queryable.undeclare()  # type: ignore[no-untyped-call]


async def test_a_name_resolves_to_the_robot_that_has_it(meeting: Meeting) -> None:
    with robots(meeting, profile(name="Lift 1"), profile(PERSON, name="Lift 2", model=OBJECTIVE)):
        await until_there(meeting, ROBOT, PERSON)
        assert await robot_address(meeting.session, meeting.seen, "lift 1") == ROBOT.address
        with raises_with(InputError, code="robot-unknown") as caught:
            await robot_address(meeting.session, meeting.seen, "Lift 1", model=OBJECTIVE)
        assert PERSON.address in caught.value.hint
        assert ROBOT.address not in caught.value.hint
        with raises_with(InputError, code="robot-unknown"):
            await robot_address(meeting.session, meeting.seen, "")


async def test_a_name_that_two_have_is_refused_with_their_addresses(meeting: Meeting) -> None:
    with robots(meeting, profile(name="Lift"), profile(PERSON, name="LIFT")):
        await until_there(meeting, ROBOT, PERSON)
        with raises_with(InputError, code="robot-ambiguous") as caught:
            await robot_address(meeting.session, meeting.seen, "Lift")
    assert ROBOT.address in str(caught.value)
    assert PERSON.address in str(caught.value)


async def test_an_address_is_taken_as_it_is(meeting: Meeting) -> None:
    assert await robot_address(meeting.session, meeting.seen, STRANGER.address.lower()) == STRANGER.address
    with pytest.raises(InvalidAddress):
        await robot_address(meeting.session, meeting.seen, "0x12")

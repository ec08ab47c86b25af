"""Presence on a channel: announced, listed and watched."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.errors import ClosedError
from mesh.network import Channel, Endpoints, Network
from schemas import PresenceKey
from tests.support.network.channels import opened
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER
from tests.support.waiting import until

if TYPE_CHECKING:
    import zenoh


async def test_presence_is_seen_while_the_channel_is_open(here: zenoh.Session, there: zenoh.Session) -> None:
    async with opened(here) as watching:
        async with opened(there) as theirs:
            theirs.announce("provider", ROBOT.address)
            theirs.announce("agent", PERSON.address)
            expected = [
                PresenceKey(MARKET, "agent", PERSON.address),
                PresenceKey(MARKET, "provider", ROBOT.address),
            ]
            await until_present(watching, expected)

        await until_present(watching, [])


async def test_presence_ends_with_the_session_of_an_unclosed_channel(router: Any, here: zenoh.Session) -> None:
    async with opened(here) as watching:
        async with Network(Endpoints(connect=(router.endpoint,))) as network:
            theirs = await Channel(network.session, MARKET).__aenter__()
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])

        await until_present(watching, [])
        await theirs.__aexit__(None, None, None)


async def test_presence_tokens_outside_the_keyspace_are_ignored(here: zenoh.Session, there: zenoh.Session) -> None:
    with (
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/agent/nobody"),
        there.liveliness().declare_token(f"aira/{MARKET}/@agent/Bad Role/{PERSON.address.lower()}"),
    ):
        async with opened(here) as watching, opened(there) as theirs:
            theirs.announce("agent", PERSON.address)
            await until_present(watching, [PresenceKey(MARKET, "agent", PERSON.address)])


async def test_a_presence_watch_reports_present_and_later_agents_of_its_role(
    here: zenoh.Session, there: zenoh.Session
) -> None:
    events: list[tuple[str, str]] = []
    async with opened(here) as watching, opened(there) as first:
        first.announce("provider", ROBOT.address)
        await until_present(watching, [PresenceKey(MARKET, "provider", ROBOT.address)])
        watching.watch_presence(
            lambda key: events.append(("appeared", key.agent)),
            gone=lambda key: events.append(("gone", key.agent)),
            role="provider",
        )
        await until(lambda: events == [("appeared", ROBOT.address.lower())])

        async with opened(there) as second:
            second.announce("agent", STRANGER.address)
            second.announce("provider", PERSON.address)
            await until(lambda: events[1:] == [("appeared", PERSON.address.lower())])
        await until(lambda: events[2:] == [("gone", PERSON.address.lower())])


async def test_a_presence_watch_ends_with_its_channel(here: zenoh.Session, there: zenoh.Session) -> None:
    seen: list[PresenceKey] = []
    other: list[PresenceKey] = []
    async with opened(there) as theirs, opened(here) as still_open:
        async with opened(here) as watching:
            watching.watch_presence(seen.append)
        still_open.watch_presence(other.append)
        theirs.announce("agent", PERSON.address)
        await until(lambda: other)

    assert seen == []
    with pytest.raises(ClosedError):
        watching.watch_presence(seen.append)


async def until_present(channel: Channel, expected: list[PresenceKey]) -> None:
    async with asyncio.timeout(60):
        while await channel.present() != expected:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("is_watching", [True, False], ids=["watching", "having watched"])
async def test_who_is_present_is_found_each_time_while_a_session_watches_and_afterwards(
    here: zenoh.Session, there: zenoh.Session, *, is_watching: bool
) -> None:
    """Zenoh loses replies to a question for tokens that its session subscribes to, some in a hundred."""
    appeared = list[PresenceKey]()
    async with opened(there) as theirs, opened(here) as asking:
        theirs.announce("provider", ROBOT.address)
        async with opened(here) as watching:
            (asking if is_watching else watching).watch_presence(appeared.append, role="provider")
            await until(lambda: appeared)
        for _ in range(150):
            answers = await asyncio.gather(*(asking.present(role) for role in ("provider", "*") * 4))
            assert answers == [[PresenceKey(MARKET, "provider", ROBOT.address)]] * 8


async def test_a_session_watches_a_role_again(here: zenoh.Session, there: zenoh.Session) -> None:
    """The second watch is told of those that the first one saw, and that have not gone since."""
    first, second = list[PresenceKey](), list[PresenceKey]()
    async with opened(there) as theirs:
        theirs.announce("provider", PERSON.address)
        async with opened(there) as leaving:
            leaving.announce("provider", ROBOT.address)
            async with opened(here) as watching:
                watching.watch_presence(first.append, role="provider")
                await until(lambda: len(first) == 2)
        async with opened(here) as watching:
            await until_present(watching, [PresenceKey(MARKET, "provider", PERSON.address)])
            watching.watch_presence(second.append, role="provider")
            await until(lambda: second)
            assert second == [PresenceKey(MARKET, "provider", PERSON.address)]

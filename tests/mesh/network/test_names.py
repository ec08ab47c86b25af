"""ENS names in orders: resolved, unknown, slow to resolve, too many."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest

from mesh.errors import RemoteError
from mesh.network import MessageValidator, Subscription, message_key
from schemas import Demand, encode, market_selector
from tests.mesh.network.channels import KEY, ORDER, contents, listening, opened, take
from tests.support.orders import LIGHTHOUSE, MARKET, STRANGER, demand
from tests.support.waiting import until_heard

if TYPE_CHECKING:
    import zenoh

NAME = "token.robonomics.eth"


def with_name(message: Demand, name: str = NAME) -> bytes:
    return json.dumps(json.loads(encode(message)) | {"token": name}).encode()


async def test_names_are_resolved_and_unknown_ones_counted(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        if name != NAME:
            raise RemoteError(f"nobody knows {name}")
        return STRANGER.address

    async with listening(here, there, resolver=resolver) as (demands, _):
        message, nameless = demand(token=STRANGER.address), demand()
        there.put(message_key(MARKET, nameless), with_name(nameless, "nobody.eth"))
        there.put(message_key(MARKET, message), with_name(message, NAME.upper()))

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid == {"name": 1}


async def test_without_a_resolver_messages_with_names_are_counted(here: zenoh.Session, there: zenoh.Session) -> None:
    async with listening(here, there) as (demands, theirs):
        there.put(KEY, with_name(ORDER))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid == {"name": 1}


async def test_a_slow_resolution_does_not_delay_other_messages(here: zenoh.Session, there: zenoh.Session) -> None:
    known = asyncio.Event()

    async def resolver(name: str) -> str:
        await known.wait()
        return STRANGER.address

    async with listening(here, there, resolver=resolver) as (demands, theirs):
        message = demand(token=STRANGER.address)
        there.put(message_key(MARKET, message), with_name(message))
        theirs.publish(other := demand())
        assert contents(await take(demands, 1)) == [other]

        known.set()
        assert contents(await take(demands, 1)) == [message]


async def test_a_limited_number_of_messages_waits_for_names(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        await asyncio.Event().wait()
        raise AssertionError

    validator = MessageValidator(Demand, lighthouse=MARKET, address=LIGHTHOUSE, head=lambda: 0)
    selector = market_selector(MARKET, "demand")
    async with (
        Subscription(here, selector, validator, resolver, lookup_limit=2) as demands,
        opened(there) as theirs,
    ):
        await until_heard(there, selector)
        for _ in range(10):
            there.put(KEY, with_name(ORDER))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid["name"] >= 7


async def test_an_unexpected_resolver_error_ends_the_iteration(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        raise ZeroDivisionError

    async with listening(here, there, resolver=resolver) as (demands, _):
        there.put(KEY, with_name(ORDER))

        with pytest.raises(ZeroDivisionError):
            await take(demands, 1)

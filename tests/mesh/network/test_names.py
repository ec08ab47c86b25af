"""Names in orders: looked up, unknown, slow to look up, too many."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest

from mesh.errors import RemoteError
from mesh.network import message_key, subscription
from schemas import Demand, encode
from tests.mesh.network.channels import KEY, ORDER, contents, listening, take
from tests.support.orders import MARKET, STRANGER, demand

if TYPE_CHECKING:
    import zenoh

NAME = "token.robonomics.eth"


def with_name(message: Demand, name: str = NAME) -> bytes:
    return json.dumps(json.loads(encode(message)) | {"token": name}).encode()


async def test_names_are_looked_up_and_unknown_ones_counted(here: zenoh.Session, there: zenoh.Session) -> None:
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


async def test_a_look_up_that_takes_long_holds_up_nobody_else(here: zenoh.Session, there: zenoh.Session) -> None:
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


async def test_only_so_many_messages_wait_for_their_names(
    here: zenoh.Session, there: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subscription, "LOOKING_UP", 2)

    async def resolver(name: str) -> str:
        await asyncio.Event().wait()
        raise AssertionError

    async with listening(here, there, resolver=resolver) as (demands, theirs):
        for _ in range(10):
            there.put(KEY, with_name(ORDER))
        theirs.publish(message := demand())

        assert contents(await take(demands, 1)) == [message]
        assert demands.statistics().invalid["name"] >= 7


async def test_what_breaks_the_resolver_comes_out_of_the_iterator(here: zenoh.Session, there: zenoh.Session) -> None:
    async def resolver(name: str) -> str:
        raise ZeroDivisionError

    async with listening(here, there, resolver=resolver) as (demands, _):
        there.put(KEY, with_name(ORDER))

        with pytest.raises(ZeroDivisionError):
            await take(demands, 1)

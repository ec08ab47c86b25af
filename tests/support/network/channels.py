"""Channels for tests, and the messages that arrive on them."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

from mesh.network import Channel, MarketRules, message_key
from schemas import Demand, SignedMessage, Verified
from tests.support.orders import LIGHTHOUSE, MARKET, demand
from tests.support.waiting import until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import zenoh

    from mesh.network import Subscription

CHANNEL_OPTIONS: Final = ("drops", "answer_timeout")


@asynccontextmanager
async def opened(session: zenoh.Session, **options: Any) -> AsyncIterator[Channel]:
    """A channel whose rules, and `drops` and `answer_timeout`, are `options`."""
    given = {"answer_timeout": 60.0} | {name: options.pop(name) for name in CHANNEL_OPTIONS if name in options}
    rules = MarketRules(MARKET, **({"address": LIGHTHOUSE} | options))
    async with Channel(session, rules, **given) as channel:
        yield channel


@asynccontextmanager
async def listening(
    here: zenoh.Session, there: zenoh.Session, kind: type[Any] = Demand, **options: Any
) -> AsyncIterator[tuple[Subscription[Any], Channel]]:
    """A subscription `here`, and a channel `there` whose messages reach it."""
    selection = {name: options.pop(name) for name in ("model",) if name in options}
    async with opened(here, **options) as ours, opened(there) as theirs, ours.subscribe(kind, **selection) as messages:
        await until_heard(there, messages.selector)
        yield messages, theirs


async def take(messages: Subscription[Any], count: int) -> list[Verified[Any]]:
    async with asyncio.timeout(60):
        return [await anext(messages) for _ in range(count)]


def contents(verified: list[Verified[Any]]) -> list[SignedMessage]:
    return [one.message for one in verified]


ORDER = demand()
KEY = message_key(MARKET, ORDER)

"""Floods of presence tokens: what is kept of them is bounded, and those who matter are found nevertheless."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING

from mesh.base.flood import Drops
from mesh.network import Channel
from mesh.network.presence import PRESENT_LIMIT
from mesh.watching import PresentPeer, present
from schemas import PresenceKey
from tests.support.orders import MARKET, ROBOT
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    import pytest
    import zenoh

FLOOD = PRESENT_LIMIT + 200


async def test_agents_are_counted_beyond_a_limit_and_providers_found(here: zenoh.Session, there: zenoh.Session) -> None:
    drops = Drops()
    async with Channel(here, MARKET, drops=drops) as watching, Channel(there, MARKET) as theirs:
        theirs.announce("provider", ROBOT.address)
        theirs.announce("zebra", ROBOT.address)
        for _ in range(FLOOD):
            theirs.announce("agent", "0x" + secrets.token_hex(20))

        async def all_came() -> bool:
            before = drops.totals().get("presence", 0)
            found = await watching.present()
            assert len(found) <= PRESENT_LIMIT
            return drops.totals().get("presence", 0) - before == FLOOD + 2 - PRESENT_LIMIT

        await until_found(all_came, what="the flood")
        assert PresentPeer("provider", ROBOT.address) in await present(watching, "provider")
        assert await watching.present(agent=ROBOT.address) == [
            PresenceKey(MARKET, role, ROBOT.address) for role in ("provider", "zebra")
        ]


async def test_who_came_when_no_more_are_remembered_is_reported_gone(
    here: zenoh.Session, there: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mesh.network.presence.KEPT", 3)
    appeared, gone = set[str](), list[str]()
    market = "quiet.lighthouse.3.robonomics.eth"  # those of the flood before may still be leaving
    async with Channel(here, market) as watching, Channel(there, market) as strangers:
        watching.watch_presence(lambda key: appeared.add(key.agent), gone=lambda key: gone.append(key.agent))
        for number in range(5):
            strangers.announce("agent", f"0x{number:040x}")
        await until(lambda: len(appeared) == 5)
        async with Channel(there, market) as theirs:
            theirs.announce("provider", ROBOT.address)
            await until(lambda: ROBOT.address.lower() in appeared)
        await until(lambda: gone == [ROBOT.address.lower()])

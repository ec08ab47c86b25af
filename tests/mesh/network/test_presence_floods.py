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
from tests.support.waiting import until_found

if TYPE_CHECKING:
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

"""Watching on a closed site: a watcher sees events, an operator reads statuses, other members can do neither."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.network import Channel, Network, Services
from mesh.ops.identity import Member
from mesh.watching import MarketWatch, PresentPeer, present, status_of
from tests.mesh.watching.test_market import EVENT, JOB
from tests.mesh.watching.test_presence import QUICK, status
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER
from tests.support.sites import Site
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.watching import RoleStatus
    from schemas.rpc import Nothing
    from schemas.status import Status

SECONDS = 60.0


async def answer(_request: Nothing) -> Status:
    return status()


@pytest.mark.parametrize(
    ("role", "may_ask", "sees_events"), [("operator", 1, True), ("watcher", 0, True), ("person", 0, False)]
)
async def test_what_each_role_sees(tmp_path: Path, role: str, may_ask: int, sees_events: bool) -> None:
    site = Site(tmp_path)
    arm = site.enlist(Member(name="arm", address=ROBOT.address, roles=("agent",)))
    own = STRANGER.address if role != "person" else PERSON.address
    who = site.enlist(Member(name="who", address=own, roles=(role,)))  # type: ignore[arg-type]

    with site.open_router("wheel"):
        async with (
            Network(site.client(arm)) as arms,
            Channel(arms.session, MARKET) as shown,
            Services(arms.session, ROBOT.address) as services,
            Network(site.client(who)) as others,
            Channel(others.session, MARKET) as seen,
        ):
            services.offer("status", answer)
            shown.announce("agent", ROBOT.address)

            async def is_seen() -> bool:
                return await present(seen) == [PresentPeer("agent", ROBOT.address)]

            async def answers() -> list[RoleStatus]:
                return await status_of(others.session, ROBOT.address, MARKET, timeout=QUICK)

            async def as_many_answer_as_may() -> bool:
                return len(await answers()) == may_ask

            async with MarketWatch(others.session, seen) as watch:
                await until_found(is_seen, what="the agent", seconds=SECONDS)
                await until_found(as_many_answer_as_may, what="the agent's answer", seconds=SECONDS)

                def events() -> int:
                    shown.put(EVENT, JOB.encode())
                    return watch.counters().received

                if sees_events:
                    await until(events, what="an event", seconds=SECONDS)
                else:
                    for _ in range(3):
                        events()
                        await answers()
                    assert watch.counters().received == 0

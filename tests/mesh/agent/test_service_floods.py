"""Floods of calls: an agent answers those that it refuses, and the others go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.network import Endpoints, Network, ServiceFailed, call
from mesh.network.services import SERVICE_LIMITS
from schemas import RpcKey
from schemas.rpc import AccountBalance, Nothing
from tests.mesh.agent.conftest import asking
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    import zenoh

    from tests.support.market import Place


async def test_balance_queries_beyond_the_rate_are_refused_with_a_code(place: Place) -> None:
    robot, queries = place.agent("robot"), 20 * int(SERVICE_LIMITS.requests.burst)
    replies: list[zenoh.Reply] = []
    async with asking(place, robot) as asker, Network(Endpoints(connect=(place.endpoint,))) as network:
        await asker.ask("status")
        key = str(RpcKey(robot.address, "eth/account_eth_balance"))
        payload = AccountBalance(place.address("person")).encode()
        for _ in range(queries):
            network.session.get(key, replies.append, payload=payload, timeout=60.0)
        asked = queries

        async def is_refused() -> bool:
            nonlocal asked
            for _ in range(100):  # else a pause lets the next call through
                network.session.get(key, replies.append, payload=payload, timeout=60.0)
            asked += 100
            try:
                await call(network.session, robot.address, "eth/account_eth_balance", AccountBalance(robot.address))
            except ServiceFailed as failed:
                return failed.reason == "busy"
            return False

        await until_found(is_refused, what="a call that is one too many")
        assert (await call(network.session, robot.address, "status", Nothing())).role == "agent"
        await until(lambda: len(replies) == asked, what="a reply to each call", seconds=60)
        answered = sum(reply.ok is not None for reply in replies)
        assert 0 < answered < queries / 2

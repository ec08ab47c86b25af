"""`aira peers`: who is on the channel, and how many nodes are on the IPFS side."""

from __future__ import annotations

import json
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import msgspec

from mesh.cli.status import peers
from mesh.network import Channel, Endpoints, Network
from mesh.network.presence import PRESENT_LIMIT
from mesh.settings import Settings
from mesh.watching import present
from schemas.status import BridgeStatus, bridge_status_key
from tests.mesh.watching.test_presence import answering, bridge_status
from tests.support.commands import coroutine
from tests.support.orders import MARKET, PERSON, ROBOT, STRANGER
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import pytest

    from tests.support.routers import EmbeddedRouter

NODES = ("QmA", "QmB", "QmC")


@asynccontextmanager
async def bridging(router: EmbeddedRouter, *bridges: BridgeStatus) -> AsyncIterator[Settings]:
    """A channel with an agent and bridges with these statuses; gives the settings of a client."""
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, MARKET) as channel,
        AsyncExitStack() as stack,
    ):
        channel.announce("agent", ROBOT.address)
        for status in bridges:
            channel.announce("bridge", status.bridge)
            stack.enter_context(answering(network.session, bridge_status_key(status.bridge, MARKET), status.encode()))
        async with Network(Endpoints(connect=(router.endpoint,))) as reader, Channel(reader.session, MARKET) as seen:
            for status in bridges:
                await until_answered(reader.session, bridge_status_key(status.bridge, MARKET))

            async def all_there() -> bool:
                return len(await present(seen)) == 1 + len(bridges)

            await until_found(all_there, what="everybody", seconds=30)
        yield Settings(connect=(router.endpoint,), connect_timeout=30.0)


async def test_an_empty_channel_is_printed_as_a_line(
    router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]
) -> None:
    await coroutine(peers)(Settings(connect=(router.endpoint,)), as_json=False)
    assert capsys.readouterr().out == f"0 peers on {MARKET}; IPFS side: unknown, there is no bridge\n"


async def test_peers_are_listed_by_role_and_address(router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]) -> None:
    connected = msgspec.structs.replace(bridge_status(), ipfs_peers=NODES, state="connected")
    async with bridging(router, connected) as settings:
        await coroutine(peers)(settings, as_json=False)
        assert capsys.readouterr().out.splitlines() == [
            "role    address",
            f"agent   {ROBOT.address}",
            f"bridge  {STRANGER.address}",
            f"2 peers on {MARKET}; IPFS side: 3 nodes",
        ]
        await coroutine(peers)(settings, as_json=True)
        assert json.loads(capsys.readouterr().out) == {
            "lighthouse": MARKET,
            "peers": [
                {"role": "agent", "address": ROBOT.address},
                {"role": "bridge", "address": STRANGER.address},
            ],
            "ipfsPeers": list(NODES),
            "unlisted": 0,
        }


async def test_a_flood_of_agents_hides_no_bridge(router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]) -> None:
    flood = PRESENT_LIMIT + 76
    async with (
        bridging(router, bridge_status()) as settings,
        Network(Endpoints(connect=(router.endpoint,))) as attacker,
        Channel(attacker.session, MARKET) as channel,
    ):
        for number in range(flood - 2):
            channel.announce("agent", f"0x{number:040x}")

        async def found() -> bool:
            await coroutine(peers)(settings, as_json=True)
            said = json.loads(capsys.readouterr().out)
            assert {"role": "bridge", "address": STRANGER.address} in said["peers"]
            assert len(said["peers"]) <= PRESENT_LIMIT + 1
            return bool(said["unlisted"] == flood - PRESENT_LIMIT)

        await until_found(found, what="all tokens", seconds=60)


async def test_of_several_bridges_the_one_that_carries_is_used(
    router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]
) -> None:
    carries = msgspec.structs.replace(bridge_status(), ipfs_peers=NODES[:1], state="connected")
    stands_by = msgspec.structs.replace(bridge_status(bridge=PERSON.address), ipfs_peers=NODES, carries=False)
    async with bridging(router, stands_by, carries) as settings:
        await coroutine(peers)(settings, as_json=False)
    assert capsys.readouterr().out.endswith("IPFS side: 1 node\n")


async def test_a_bridge_without_its_daemon_says_so(router: EmbeddedRouter, capsys: pytest.CaptureFixture[str]) -> None:
    async with bridging(router, msgspec.structs.replace(bridge_status(), state="no daemon")) as settings:
        await coroutine(peers)(settings, as_json=False)
    assert capsys.readouterr().out.endswith("IPFS side: 0 nodes; the bridge reports: no daemon\n")

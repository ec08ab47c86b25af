from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from bridges.ipfs import BridgeStatus, status_key
from bridges.ipfs.status import WINDOW, Rate
from mesh.network import Channel, Endpoints, Network
from tests.bridges.ipfs.bridges import bridging
from tests.support.ports import free_port
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter


async def test_a_bridge_shows_its_presence_and_answers_how_it_is(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    api = f"http://127.0.0.1:{free_port()}"
    async with (
        bridging(router.endpoint, api, topic, tmp_path / "journal") as bridge,
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, topic) as channel,
    ):
        channel.announce("agent", "0x" + "12" * 20)

        async def both() -> bool:
            return {key.role for key in await channel.present()} == {"agent", "bridge"}

        await until_found(both, seconds=30)
        found = next(key for key in await channel.present() if key.role == "bridge")
        assert found.agent == bridge.address

        async def ask() -> BridgeStatus:
            key = status_key("0x" + "0" * 40, topic).replace("0x" + "0" * 40, "*")
            replies = await asyncio.to_thread(lambda: list(network.session.get(key, timeout=10.0)))
            (reply,) = [reply.ok for reply in replies if reply.ok is not None]
            assert str(reply.key_expr) == status_key(found.agent, topic)
            return BridgeStatus.decode(reply.payload.to_bytes())

        async def tells_of_both() -> bool:
            return len((await ask()).mesh_peers) == 2

        await until_found(tells_of_both, seconds=30)
        status = await ask()
        assert (status.lighthouse, status.api, status.state, status.carries) == (topic, api, "no daemon", False)
        assert status.mesh_peers == (f"agent 0x{'12' * 20}", f"bridge {bridge.address}")
        assert status.to_ipfs.received == status.to_mesh.received == 0


def test_a_rate_is_over_the_last_seconds() -> None:
    now = 100.0
    rate = Rate(lambda: now)
    for _ in range(20):
        rate.count()
    assert rate.per_second() == 20 / WINDOW
    now += WINDOW / 2
    rate.count()
    assert rate.per_second() == 21 / WINDOW
    now += WINDOW / 2 + 1
    assert rate.per_second() == 1 / WINDOW

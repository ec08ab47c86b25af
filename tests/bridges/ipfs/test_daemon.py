"""The client of a daemon's RPC, on real daemons."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ipfs import Daemon, IpfsError
from bridges.ipfs.daemon import ADD_OPTIONS
from mesh.errors import ClosedError
from schemas import CHUNK_SIZE, cid_of_bytes
from tests.support.ipfs import Kubo
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.ipfs_bridge.legacy import LegacyClient

DATA = bytes(range(256)) + b'{"tx":"\n"}'
OTHER = "12D3KooWRBhwfeP2Y4TCx1SM6s9rUoHhR5STiGwxBhgFRcw3UERE"
NEEDED = ("version", "id", "pubsub", "swarm", "add", "block", "pin")


class ProtectedKubo(Kubo):
    """A Kubo that requires a secret, which opens the calls that a bridge needs."""

    def configure(self, config: dict[str, Any]) -> None:
        super().configure(config)
        paths = [f"/api/v0/{call}" for call in NEEDED]
        config["API"] = {"Authorizations": {"bridge": {"AuthSecret": "bearer:right", "AllowedPaths": paths}}}


@pytest.fixture
async def daemon(swarm: Swarm) -> AsyncIterator[Daemon]:
    async with Daemon(swarm.a.api) as daemon:
        await daemon.detect_version()
        yield daemon


async def test_version_and_identity(daemon: Daemon, swarm: Swarm) -> None:
    assert daemon.version
    assert daemon.version.version
    assert daemon.dialect == "multibase"
    assert await daemon.identity() == swarm.a.peer_id

    async def is_connected() -> bool:
        return swarm.b.peer_id in await daemon.swarm_peers()

    await until_found(is_connected, what="the other daemon", seconds=30)


async def test_a_message_reaches_a_client_of_another_daemon_unchanged(
    daemon: Daemon, bob: LegacyClient, topic: str
) -> None:
    await bob.listen(topic)
    await until_found(lambda: daemon.listeners(topic), seconds=30)
    await daemon.publish(topic, DATA)
    await until_found(lambda: _heard(bob, 1), seconds=30)
    assert bob.heard == [DATA]


async def test_a_subscription_receives_other_and_own_messages(
    daemon: Daemon, bob: LegacyClient, swarm: Swarm, topic: str
) -> None:
    async with asyncio.timeout(60), daemon.subscribe(topic) as events:
        await until_found(lambda: bob.peers(topic), seconds=30)
        await bob.publish(topic, DATA)
        event = await anext(events)
        assert event is not None
        assert (event.sender, event.data) == (swarm.b.peer_id, DATA)
        await daemon.publish(topic, b"mine")
        own = await anext(events)
        assert own is not None
        assert (own.sender, own.data) == (swarm.a.peer_id, b"mine")


async def test_a_js_daemon_reports_missing_listeners(daemon: Daemon, topic: str) -> None:
    assert await daemon.listeners(topic) == []
    assert daemon.version
    if daemon.version.js_core:
        with raises_with(IpfsError, code="no-peers"):
            await daemon.publish(topic, b"hello")
    else:
        await daemon.publish(topic, b"hello")


@pytest.mark.parametrize("size", [0, 1, CHUNK_SIZE + 1])
async def test_a_file_is_added_under_the_meshs_cid(daemon: Daemon, tmp_path: Path, size: int) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"x" * size)
    assert await daemon.add(file) == cid_of_bytes(b"x" * size)


async def test_a_block_of_another_node_is_fetched_and_pinned(daemon: Daemon, bob: LegacyClient) -> None:
    content = b"of bob's own" * 1000
    name = (await bob.call("add", *ADD_OPTIONS, content=content))["Hash"]
    block = await daemon.block(name, limit=20_000, timeout=30)
    assert content in block
    await daemon.pin(name, timeout=30)
    with pytest.raises(IpfsError):
        await daemon.block(name, limit=100)


async def test_a_missing_block_times_out(daemon: Daemon) -> None:
    with pytest.raises(IpfsError):
        await daemon.block(cid_of_bytes(b"nobody has this"), limit=1000, timeout=0.5)


async def test_a_refused_call_carries_the_daemons_message(daemon: Daemon) -> None:
    with pytest.raises(IpfsError) as refused:
        await daemon.connect("/ip4/127.0.0.1/tcp/1/p2p/nonsense")
    assert str(refused.value) > f"IPFS at {daemon.api}: "


async def test_a_protected_kubo_accepts_the_right_secret_only(topic: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"behind a secret")
    async with ProtectedKubo() as kubo:
        async with Daemon(kubo.api, authorization="Bearer right") as daemon, daemon.subscribe(topic) as events:
            await daemon.detect_version()
            assert await daemon.identity() == kubo.peer_id
            assert await daemon.listeners(topic) == await daemon.swarm_peers() == []
            await daemon.publish(topic, DATA)
            event = await anext(events)
            assert event is not None
            assert event.data == DATA
            name = await daemon.add(file)
            block = await daemon.block(name, limit=1000)
            await daemon.put_block(block)
            await daemon.pin(name)
            await daemon.unpin(name)
            with pytest.raises(IpfsError) as refused:
                await daemon.connect(f"/ip4/127.0.0.1/tcp/{free_port()}/p2p/{OTHER}")
            assert refused.value.code == "daemon-refused"
        async with Daemon(kubo.api, authorization="Bearer wrong") as daemon:
            with pytest.raises(IpfsError) as denied:
                await daemon.detect_version()
            assert denied.value.code == "access-denied"


async def test_a_missing_daemon_is_unreachable() -> None:
    async with Daemon(f"/ip4/127.0.0.1/tcp/{free_port()}") as daemon:
        with raises_with(IpfsError, code="daemon-unreachable"):
            await daemon.detect_version()


async def test_a_daemon_that_accepts_but_never_answers_is_unreachable(topic: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as frozen:  # nobody accepts; the kernel does
        api = f"http://127.0.0.1:{frozen.getsockname()[1]}"
        async with asyncio.timeout(60), Daemon(api, call_timeout=0.5) as daemon:
            with raises_with(IpfsError, code="daemon-unreachable"):
                async with daemon.subscribe(topic):
                    pass


async def test_a_client_is_used_inside_async_with() -> None:
    with pytest.raises(ClosedError):
        await Daemon("http://127.0.0.1:5001").detect_version()


async def _heard(client: LegacyClient, count: int) -> bool:
    return len(client.heard) >= count

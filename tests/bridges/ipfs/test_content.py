"""Content between stores of the mesh and real IPFS nodes."""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import web

from bridges.ipfs import Daemon
from bridges.ipfs._content import RAW, ContentBridge, ContentParts, ContentSources, Gateway
from bridges.ipfs.daemon import ADD_OPTIONS
from mesh.base.retry import RetryPolicy
from mesh.content import ContentTooLarge, ContentUnavailable, Exchange, Store
from mesh.network import Endpoints, Network
from schemas import CHUNK_SIZE, MAX_LINKS, blocks_of_stream, cid_of_bytes
from tests.support.content import chunked
from tests.support.ipfs import Kubo
from tests.support.ipfs_bridge.legacy import LegacyClient
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.routers import EmbeddedRouter

SECONDS = 90.0
SIZES = [0, 1, CHUNK_SIZE + 1, 3 * CHUNK_SIZE]


@dataclass
class Agent:
    """An agent with a store."""

    store: Store
    exchange: Exchange


@asynccontextmanager
async def agent(endpoint: str, folder: Path) -> AsyncIterator[Agent]:
    async with Network(Endpoints(connect=(endpoint,))) as network:
        with Store(folder) as store:
            async with Exchange(network.session, store) as exchange:
                yield Agent(store, exchange)


@dataclass
class RunningBridge:
    """A content bridge with its store and daemon."""

    content: ContentBridge
    store: Store
    daemon: Daemon


@asynccontextmanager
async def bridged(
    endpoint: str, api: str, folder: Path, *more: Gateway, **options: Any
) -> AsyncIterator[RunningBridge]:
    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        store = stack.enter_context(Store(folder))
        exchange = await stack.enter_async_context(Exchange(network.session, store))
        daemon = await stack.enter_async_context(Daemon(api))
        names = ("size_limit", "timeout", "providers", "drops")
        given: dict[str, Any] = {"size_limit": 2**26, "timeout": 30.0}
        given |= {name: options.pop(name) for name in names if name in options}
        parts = ContentParts(
            session=network.session,
            store=store,
            exchange=exchange,
            sources=ContentSources(daemon, *more),
            daemon=daemon,
            **given,
        )
        bridge = ContentBridge(parts, **options)
        yield RunningBridge(await stack.enter_async_context(bridge), store, daemon)


def events(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.__dict__.get("event", "") for record in caplog.records]


def content_of(size: int, seed: str) -> bytes:
    """Bytes unique to a test: a daemon keeps what it once had."""
    block = sha256(seed.encode()).digest()
    return (block * (size // len(block) + 1))[:size]


@pytest.mark.parametrize("size", SIZES)
async def test_a_file_on_ipfs_is_served_to_the_mesh_and_stored(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path, size: int
) -> None:
    content = content_of(size, str(tmp_path))
    cid = (await bob.call("add", *ADD_OPTIONS, content=content))["Hash"]
    assert cid == cid_of_bytes(content)
    async with (
        bridged(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge,
        agent(router.endpoint, tmp_path / "agent") as robot,
    ):
        path = await robot.exchange.fetch(cid, timeout=SECONDS)
        assert path.read_bytes() == content
        await until(lambda: bridge.store.has(cid), what="the file in the bridge's store", seconds=SECONDS)
        await until(lambda: bridge.content.metrics().fetched == 1, seconds=SECONDS)
        await bridge.content.fetch(cid)
        assert bridge.content.metrics().fetched == 1, "it is held already"


async def test_a_file_chunked_otherwise_is_verified_block_by_block(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(100_000, str(tmp_path))
    other = (("cid-version", "0"), ("raw-leaves", "false"), ("chunker", "size-10000"), ("hash", "sha2-256"))
    cid = (await bob.call("add", *other, content=content))["Hash"]
    assert cid != cid_of_bytes(content)
    async with bridged(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge:
        assert (await bridge.content.fetch(cid)).read_bytes() == content


async def test_a_missing_file_times_out(swarm: Swarm, router: EmbeddedRouter, tmp_path: Path) -> None:
    async with bridged(router.endpoint, swarm.a.api, tmp_path / "bridge", timeout=1.0) as bridge:
        with pytest.raises(ContentUnavailable):
            await bridge.content.fetch(cid_of_bytes(str(tmp_path).encode()))


async def test_a_file_that_is_too_large_is_rejected_by_its_root(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(2 * CHUNK_SIZE, str(tmp_path))
    cid = (await bob.call("add", *ADD_OPTIONS, content=content))["Hash"]
    async with bridged(router.endpoint, swarm.a.api, tmp_path / "bridge", size_limit=CHUNK_SIZE) as bridge:
        with pytest.raises(ContentTooLarge):
            await bridge.content.fetch(cid)
        assert bridge.content.metrics().fetched == 0


@pytest.mark.parametrize("size", [10, 2 * CHUNK_SIZE + 5])
async def test_a_file_of_the_mesh_is_added_under_its_cid_and_pinned_on_providers(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path, size: int
) -> None:
    content = content_of(size, str(tmp_path))
    async with (
        Daemon(swarm.b.api) as further,
        agent(router.endpoint, tmp_path / "agent") as person,
        bridged(router.endpoint, swarm.a.api, tmp_path / "bridge", providers=(further,)) as bridge,
    ):
        cid = await asyncio.to_thread(person.store.put_bytes, content)
        await bridge.content.add(cid)
        counts = bridge.content.metrics()
        assert (counts.added, counts.by_blocks, counts.pinned) == (1, 0, 1)
        pins = await bob.call("pin/ls", ("arg", cid), ("type", "recursive"))
        assert cid in json.dumps(pins)


async def test_a_file_named_before_it_exists_is_added_later(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "bridges.ipfs._content")
    content = content_of(1000, str(tmp_path))
    async with (
        agent(router.endpoint, tmp_path / "agent") as person,
        bridged(
            router.endpoint,
            swarm.a.api,
            tmp_path / "bridge",
            timeout=2.0,
            add_retry=RetryPolicy(initial=0.5, factor=1.0, attempts=40),
        ) as bridge,
    ):
        bridge.content.adds.add(cid_of_bytes(content), "")
        await until(lambda: "transfer-retried" in events(caplog), seconds=SECONDS)
        cid = await asyncio.to_thread(person.store.put_bytes, content)
        await until(lambda: bridge.content.metrics().added == 1, seconds=SECONDS)
        assert bridge.content.metrics().failed == 0
        assert await bob.cat(cid) == content


async def test_a_file_that_never_appears_counts_as_failed(router: EmbeddedRouter, tmp_path: Path) -> None:
    api = f"http://127.0.0.1:{free_port()}"
    async with bridged(
        router.endpoint,
        api,
        tmp_path / "bridge",
        timeout=0.2,
        add_retry=RetryPolicy(initial=0.05, factor=1.0, attempts=4),
    ) as bridge:
        bridge.content.adds.add(cid_of_bytes(str(tmp_path).encode()), "")
        await until(lambda: bridge.content.metrics().failed == 1, seconds=SECONDS)
        assert bridge.content.metrics().added == 0


async def test_a_file_chunked_otherwise_is_added_block_by_block(
    swarm: Swarm, bob: LegacyClient, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(50_000, str(tmp_path))
    blocks = {block.cid: block.data for block in chunked(content, 10_000)}
    cid = next(reversed(blocks))
    assert cid != cid_of_bytes(content)
    async with (
        gateway(blocks) as address,
        Gateway(address) as source,
        bridged(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge,
    ):
        await ContentSources(source).fetch(bridge.store, cid, size_limit=2**20, timeout=SECONDS)
        await bridge.content.add(cid)
        counts = bridge.content.metrics()
        assert (counts.added, counts.by_blocks, counts.added_bytes) == (1, 1, len(content))
        assert await bob.cat(cid) == content
        async with LegacyClient(swarm.a.api) as client:
            pins = json.dumps(await client.call("pin/ls", ("type", "recursive")))
        assert cid in pins
        assert cid_of_bytes(content) not in pins


@asynccontextmanager
async def gateway(blocks: dict[str, bytes], media_type: str = RAW) -> AsyncIterator[str]:
    """A gateway like public ones."""

    async def answer(request: web.Request) -> web.Response:
        assert request.query["format"] == "raw"
        block = blocks.get(request.match_info["cid"])
        if block is None:
            return web.Response(status=504, text="no providers found")
        return web.Response(body=block, content_type=media_type)

    app = web.Application()
    app.router.add_get("/ipfs/{cid}", answer)
    runner, port = web.AppRunner(app), free_port()
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        await runner.cleanup()


def blocks_of(folder: Path, content: bytes) -> dict[str, bytes]:
    file = folder / "content"
    file.write_bytes(content)
    with file.open("rb") as stream:
        return {block.cid: block.data for block in blocks_of_stream(stream)}


async def test_a_gateway_replaces_a_missing_daemon(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(2 * CHUNK_SIZE + 7, str(tmp_path))
    async with (
        gateway(blocks_of(tmp_path, content)) as address,
        Gateway(address) as source,
        bridged(router.endpoint, f"http://127.0.0.1:{free_port()}", tmp_path / "bridge", source),
        agent(router.endpoint, tmp_path / "agent") as robot,
    ):
        path = await robot.exchange.fetch(cid_of_bytes(content), timeout=SECONDS)
        assert path.read_bytes() == content


@pytest.mark.parametrize("kind", ["kubo"], indirect=True)  # the gateway of a js-ipfs gives no blocks
async def test_a_kubos_own_gateway_is_a_source(swarm: Swarm, bob: LegacyClient, tmp_path: Path) -> None:
    assert isinstance(swarm.b, Kubo)
    content = content_of(CHUNK_SIZE + 1, str(tmp_path))
    cid = (await bob.call("add", *ADD_OPTIONS, content=content))["Hash"]
    async with Gateway(swarm.b.gateway) as source:
        with Store(tmp_path / "store") as store:
            path = await ContentSources(source).fetch(store, cid, size_limit=2**20, timeout=SECONDS)
            assert path.read_bytes() == content


async def test_a_corrupt_block_of_a_gateway_is_rejected(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(1000, str(tmp_path))
    cid = cid_of_bytes(content)
    async with gateway({cid: b"something else"}) as address, Gateway(address) as source:
        sources = ContentSources(source)
        with Store(tmp_path / "store") as store, pytest.raises(ContentUnavailable):
            await sources.fetch(store, cid, size_limit=2**20, timeout=10.0)
        assert sources.corrupt == {address: 1}
        with Store(tmp_path / "store") as store:
            assert not store.has(cid)


async def test_a_gateway_that_serves_only_whole_files_is_unusable(tmp_path: Path) -> None:
    content = content_of(1000, str(tmp_path))
    async with gateway(blocks_of(tmp_path, content), "text/html") as address, Gateway(address) as source:
        with pytest.raises(ContentUnavailable):
            await ContentSources(source).block(cid_of_bytes(content), timeout=5.0)


async def test_a_large_file_with_several_levels_of_links(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(CHUNK_SIZE * (MAX_LINKS + 1), str(tmp_path))
    async with gateway(blocks_of(tmp_path, content)) as address, Gateway(address) as source:
        with Store(tmp_path / "store") as store:
            path = await ContentSources(source).fetch(store, cid_of_bytes(content), size_limit=2**27, timeout=SECONDS)
            assert path.stat().st_size == len(content)
            await asyncio.to_thread(store.verify, cid_of_bytes(content))

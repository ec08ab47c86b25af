"""Content between the mesh's stores and real IPFS nodes."""

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
from bridges.ipfs.content import ContentBridge
from bridges.ipfs.daemon import SETTINGS
from bridges.ipfs.gateway import RAW, Gateway
from bridges.ipfs.sources import Source, Sources
from mesh.content import ContentTooLarge, ContentUnavailable, Exchange, Store
from mesh.network import Endpoints, Network
from schemas import CHUNK_SIZE, MAX_LINKS, blocks_of_stream, cid_of_bytes
from tests.bridges.ipfs.legacy import Bare
from tests.support.content import chunked
from tests.support.ipfs import Kubo
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
    """Somebody of the mesh with a store."""

    store: Store
    exchange: Exchange


@asynccontextmanager
async def agent(endpoint: str, folder: Path) -> AsyncIterator[Agent]:
    async with Network(Endpoints(connect=(endpoint,))) as network:
        with Store(folder) as store:
            async with Exchange(network.session, store) as exchange:
                yield Agent(store, exchange)


@dataclass
class MessageValidator:
    """A content bridge with its store."""

    content: ContentBridge
    store: Store
    daemon: Daemon


@asynccontextmanager
async def door(endpoint: str, api: str, folder: Path, *more: Source, **options: Any) -> AsyncIterator[MessageValidator]:
    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(connect=(endpoint,))))
        store = stack.enter_context(Store(folder))
        exchange = await stack.enter_async_context(Exchange(network.session, store))
        daemon = await stack.enter_async_context(Daemon(api))
        settings = {"size_limit": 2**26, "timeout": 30.0} | options
        bridge = ContentBridge(network.session, store, exchange, Sources(daemon, *more), daemon, **settings)
        yield MessageValidator(await stack.enter_async_context(bridge), store, daemon)


def content_of(size: int, seed: str) -> bytes:
    """Bytes that no other test has: a daemon keeps what it once had."""
    block = sha256(seed.encode()).digest()
    return (block * (size // len(block) + 1))[:size]


@pytest.mark.parametrize("size", SIZES)
async def test_what_only_ipfs_has_comes_to_whoever_asks_in_the_mesh_and_is_kept(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path, size: int
) -> None:
    content = content_of(size, str(tmp_path))
    cid = (await bob.call("add", *SETTINGS, content=content))["Hash"]
    assert cid == cid_of_bytes(content)
    async with (
        door(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge,
        agent(router.endpoint, tmp_path / "agent") as robot,
    ):
        path = await robot.exchange.fetch(cid, timeout=SECONDS)
        assert path.read_bytes() == content
        await until(lambda: bridge.store.has(cid), what="the file in the bridge's store", seconds=SECONDS)
        await until(lambda: bridge.content.figures().fetched == 1, seconds=SECONDS)


async def test_a_file_made_with_other_settings_is_checked_block_by_block_too(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(100_000, str(tmp_path))
    other = (("cid-version", "0"), ("raw-leaves", "false"), ("chunker", "size-10000"), ("hash", "sha2-256"))
    cid = (await bob.call("add", *other, content=content))["Hash"]
    assert cid != cid_of_bytes(content)
    async with door(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge:
        assert (await bridge.content.fetch(cid)).read_bytes() == content


async def test_what_nobody_has_is_given_up_after_its_time(swarm: Swarm, router: EmbeddedRouter, tmp_path: Path) -> None:
    async with door(router.endpoint, swarm.a.api, tmp_path / "bridge", timeout=1.0) as bridge:
        with pytest.raises(ContentUnavailable):
            await bridge.content.fetch(cid_of_bytes(str(tmp_path).encode()))


async def test_a_file_that_is_too_large_is_refused_by_its_first_block(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(2 * CHUNK_SIZE, str(tmp_path))
    cid = (await bob.call("add", *SETTINGS, content=content))["Hash"]
    async with door(router.endpoint, swarm.a.api, tmp_path / "bridge", size_limit=CHUNK_SIZE) as bridge:
        with pytest.raises(ContentTooLarge):
            await bridge.content.fetch(cid)
        assert bridge.content.figures().fetched == 0


@pytest.mark.parametrize("size", [10, 2 * CHUNK_SIZE + 5])
async def test_what_is_made_in_the_mesh_is_added_under_its_name_and_pinned_by_further_nodes(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path, size: int
) -> None:
    content = content_of(size, str(tmp_path))
    async with (
        Daemon(swarm.b.api) as further,
        agent(router.endpoint, tmp_path / "agent") as person,
        door(router.endpoint, swarm.a.api, tmp_path / "bridge", providers=(further,)) as bridge,
    ):
        cid = await asyncio.to_thread(person.store.put_bytes, content)
        await bridge.content.add(cid)
        figures = bridge.content.figures()
        assert (figures.added, figures.by_blocks, figures.pinned) == (1, 0, 1)
        pins = await bob.call("pin/ls", ("arg", cid), ("type", "recursive"))
        assert cid in json.dumps(pins)


async def test_what_a_message_names_before_it_is_there_is_added_when_it_comes(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "bridges.ipfs.content")
    content = content_of(1000, str(tmp_path))
    async with (
        agent(router.endpoint, tmp_path / "agent") as person,
        door(router.endpoint, swarm.a.api, tmp_path / "bridge", timeout=2.0, again=0.5) as bridge,
    ):
        bridge.content.add_soon(cid_of_bytes(content))
        await until(lambda: "not added to IPFS yet" in caplog.text, seconds=SECONDS)
        cid = await asyncio.to_thread(person.store.put_bytes, content)
        await until(lambda: bridge.content.figures().added == 1, seconds=SECONDS)
        assert bridge.content.figures().failed == 0
        assert await bob.cat(cid) == content


async def test_what_never_comes_is_given_up_and_counted(router: EmbeddedRouter, tmp_path: Path) -> None:
    api = f"http://127.0.0.1:{free_port()}"
    async with door(router.endpoint, api, tmp_path / "bridge", timeout=0.2, again=0.05) as bridge:
        bridge.content.add_soon(cid_of_bytes(str(tmp_path).encode()))
        await until(lambda: bridge.content.figures().failed == 1, seconds=SECONDS)
        assert bridge.content.figures().added == 0


async def test_a_file_that_the_daemon_would_name_otherwise_is_given_to_it_block_by_block(
    swarm: Swarm, bob: Bare, router: EmbeddedRouter, tmp_path: Path
) -> None:
    content = content_of(50_000, str(tmp_path))
    blocks = {block.cid: block.data for block in chunked(content, 10_000)}
    cid = next(reversed(blocks))
    assert cid != cid_of_bytes(content)
    async with (
        gateway(blocks) as address,
        Gateway(address) as source,
        door(router.endpoint, swarm.a.api, tmp_path / "bridge") as bridge,
    ):
        await Sources(source).fetch(bridge.store, cid, size_limit=2**20, timeout=SECONDS, patience=10.0)
        await bridge.content.add(cid)
        figures = bridge.content.figures()
        assert (figures.added, figures.by_blocks, figures.added_bytes) == (1, 1, len(content))
        assert await bob.cat(cid) == content
        async with Bare(swarm.a.api) as client:
            pins = json.dumps(await client.call("pin/ls", ("type", "recursive")))
        assert cid in pins
        assert cid_of_bytes(content) not in pins


@asynccontextmanager
async def gateway(blocks: dict[str, bytes], media_type: str = RAW) -> AsyncIterator[str]:
    """A gateway as public ones are."""

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


async def test_a_gateway_serves_where_there_is_no_daemon(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(2 * CHUNK_SIZE + 7, str(tmp_path))
    async with (
        gateway(blocks_of(tmp_path, content)) as address,
        Gateway(address) as source,
        door(router.endpoint, f"http://127.0.0.1:{free_port()}", tmp_path / "bridge", source),
        agent(router.endpoint, tmp_path / "agent") as robot,
    ):
        path = await robot.exchange.fetch(cid_of_bytes(content), timeout=SECONDS)
        assert path.read_bytes() == content


@pytest.mark.parametrize("kind", ["kubo"], indirect=True)  # the gateway of a js-ipfs gives no blocks
async def test_a_kubos_own_gateway_is_a_source(swarm: Swarm, bob: Bare, tmp_path: Path) -> None:
    assert isinstance(swarm.b, Kubo)
    content = content_of(CHUNK_SIZE + 1, str(tmp_path))
    cid = (await bob.call("add", *SETTINGS, content=content))["Hash"]
    async with Gateway(swarm.b.gateway) as source:
        with Store(tmp_path / "store") as store:
            path = await Sources(source).fetch(store, cid, size_limit=2**20, timeout=SECONDS, patience=10.0)
            assert path.read_bytes() == content


async def test_a_gateway_that_lies_is_not_believed(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(1000, str(tmp_path))
    cid = cid_of_bytes(content)
    async with gateway({cid: b"something else"}) as address, Gateway(address) as source:
        sources = Sources(source)
        with Store(tmp_path / "store") as store, pytest.raises(ContentUnavailable, match="other bytes"):
            await sources.fetch(store, cid, size_limit=2**20, timeout=10.0, patience=5.0)
        assert sources.lies == {address: 1}
        with Store(tmp_path / "store") as store:
            assert not store.has(cid)


async def test_a_gateway_that_gives_only_whole_files_is_no_source(tmp_path: Path) -> None:
    content = content_of(1000, str(tmp_path))
    async with gateway(blocks_of(tmp_path, content), "text/html") as address, Gateway(address) as source:
        with pytest.raises(ContentUnavailable, match="only whole files"):
            await Sources(source).block(cid_of_bytes(content), timeout=5.0)


async def test_a_large_file_comes_through_with_several_levels_of_links(router: EmbeddedRouter, tmp_path: Path) -> None:
    content = content_of(CHUNK_SIZE * (MAX_LINKS + 1), str(tmp_path))
    async with gateway(blocks_of(tmp_path, content)) as address, Gateway(address) as source:
        with Store(tmp_path / "store") as store:
            path = await Sources(source).fetch(
                store, cid_of_bytes(content), size_limit=2**27, timeout=SECONDS, patience=10.0
            )
            assert path.stat().st_size == len(content)
            await asyncio.to_thread(store.verify, cid_of_bytes(content))

"""Downloads from several holders, interrupted downloads, and trees that are refused."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections import Counter
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.content import ContentCorrupt, ContentUnavailable, Exchange, Store, StoreFull
from schemas.keys import cid_selector
from schemas.unixfs import CHUNK_SIZE, write_bytes, write_number
from tests.support.content import (
    ROOT,
    answer_queries,
    block_of,
    blocks_by_cid,
    digest,
    holder_of,
    leaf,
    leftovers,
    parent,
    requested_cid,
    sample_bytes,
    until_held,
)
from tests.support.raising import raises_with
from tests.support.routers import EmbeddedRouter, client_config
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

from schemas.unixfs import UnixfsBlock

FETCHER = """
import asyncio, sys, zenoh
from mesh.content import Exchange, Store
from tests.support.routers import client_config
async def main(endpoint, directory, cid):
    with zenoh.open(client_config(endpoint)) as session, Store(directory) as store:
        async with Exchange(session, store, width=4) as exchange:
            await exchange.fetch(cid, timeout=60)
            print("fetched", exchange.statistics().fetched_blocks, flush=True)
asyncio.run(main(*sys.argv[1:]))
"""


async def test_all_holders_of_a_file_serve_parts_of_it(tmp_path: Path, store: Store, router: EmbeddedRouter) -> None:
    data = sample_bytes(60 * CHUNK_SIZE)
    async with AsyncExitStack() as stack:
        holders = []
        for number in range(3):
            session = stack.enter_context(zenoh.open(client_config(router.endpoint)))
            held = stack.enter_context(Store(tmp_path / str(number)))
            cid = await asyncio.to_thread(held.put_bytes, data)
            holders.append(await stack.enter_async_context(Exchange(session, held)))
        session = stack.enter_context(zenoh.open(client_config(router.endpoint)))
        exchange = await stack.enter_async_context(Exchange(session, store))
        await until_held(session, cid, holders=3)
        before = [holder.statistics().served for holder in holders]
        reported: list[tuple[int, int | None]] = []
        path = await exchange.fetch(cid, progress=lambda done, total: reported.append((done, total)))
        assert path.read_bytes() == data
        served = [holder.statistics().served - count for holder, count in zip(holders, before, strict=True)]
        assert min(served) >= 5, f"one of them was hardly asked: {served}"
        assert sum(served) <= 61 + 10, "only the root is requested from all"
        assert reported == sorted(reported)
        assert reported[-1] == (len(data), len(data))


async def test_a_holder_with_every_tenth_block_corrupt_is_named(
    store: Store,
    holder_store: Store,
    session: zenoh.Session,
    other_session: zenoh.Session,
    third_session: zenoh.Session,
    caplog: pytest.LogCaptureFixture,
) -> None:
    data = sample_bytes(60 * CHUNK_SIZE)
    cid, blocks = holder_store.put_bytes(data), blocks_by_cid(data)
    answers: Counter[str] = Counter()

    def corrupt_every_tenth(query: zenoh.Query) -> None:
        answers["all"] += 1
        block = blocks[requested_cid(query)]
        if answers["all"] % 10 == 0:
            answers["corrupt"] += 1
            block = block[:-1] + bytes([block[-1] ^ 1])
        query.reply(query.key_expr, block)

    with answer_queries(third_session, corrupt_every_tenth):
        async with Exchange(other_session, holder_store) as honest, Exchange(session, store, width=2) as exchange:
            await until_held(session, cid, holders=2)
            answers.clear()
            assert (await exchange.fetch(cid)).read_bytes() == data
            assert exchange.statistics().corrupt_blocks == {holder_of(third_session): 1}, "then it is ignored"
            assert honest.statistics().served > 0
    assert answers["corrupt"] >= 1
    events = [record for record in caplog.records if getattr(record, "event", "") == "content-block-corrupt"]
    assert {record.facts["session"] for record in events} == {str(third_session.zid())}  # type: ignore[attr-defined]
    assert holder_of(other_session) not in exchange.statistics().corrupt_blocks
    assert store.check().damaged == ()


async def test_another_process_continues_a_killed_fetch(
    tmp_path: Path, holder_store: Store, router: EmbeddedRouter, other_session: zenoh.Session
) -> None:
    data = sample_bytes(200 * CHUNK_SIZE)
    cid, blocks = holder_store.put_bytes(data), blocks_by_cid(data)
    given: Counter[str] = Counter()
    enough = 120

    def give(query: zenoh.Query) -> None:
        if enough and sum(given.values()) >= enough:
            return
        given[requested_cid(query)] += 1
        query.reply(query.key_expr, blocks[requested_cid(query)])

    command = [sys.executable, "-c", FETCHER, router.endpoint, str(tmp_path / "fetched"), cid]
    with answer_queries(other_session, give):
        fetcher = await asyncio.create_subprocess_exec(*command, cwd=ROOT, stdout=subprocess.PIPE)
        await until(lambda: sum(given.values()) >= enough, what="120 blocks", seconds=60)
        fetcher.kill()
        await fetcher.communicate()
        with Store(tmp_path / "fetched") as store:
            assert store.list() == ()
        first, enough = given.copy(), 0
        given.clear()
        done = await asyncio.to_thread(
            subprocess.run, command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True
        )
    assert done.stdout.startswith("fetched")
    again = [name for name in given if name in first]
    assert cid not in given
    assert len(again) <= 4, "at most the blocks under way when the process was killed"
    assert set(first) | set(given) == set(blocks)
    assert max(given.values()) == 1
    with Store(tmp_path / "fetched") as store:
        assert store.list() == (cid,)
        assert store.check().damaged == ()
        assert all(store.get_block(name) == block for name, block in blocks.items())
    assert leftovers(tmp_path / "fetched") == []


async def test_blocks_of_an_unfinished_fetch_are_served(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    data = sample_bytes(3 * CHUNK_SIZE)
    blocks = blocks_by_cid(data)
    first, *_, root = blocks
    some_of_them = {root: blocks[root], first: blocks[first]}

    def give(query: zenoh.Query) -> None:
        if requested_cid(query) in some_of_them:
            query.reply(query.key_expr, some_of_them[requested_cid(query)])

    async with Exchange(session, store) as exchange:
        with answer_queries(other_session, give):
            reported: list[tuple[int, int | None]] = []
            fetching = asyncio.create_task(
                exchange.fetch(root, timeout=600, progress=lambda done, total: reported.append((done, total)))
            )
            await until(lambda: (CHUNK_SIZE, len(data)) in reported, what="the first block")
            fetching.cancel()
            with pytest.raises(asyncio.CancelledError):
                await fetching
        replies = await asyncio.to_thread(lambda: list(other_session.get(cid_selector(cid=first), timeout=30.0)))
        assert [reply.ok.payload.to_bytes() for reply in replies if reply.ok] == [blocks[first]]


async def test_a_failed_fetch_leaves_no_files(store: Store, session: zenoh.Session) -> None:
    async with Exchange(session, store) as exchange:
        with pytest.raises(ContentUnavailable) as caught:
            await exchange.fetch(block_of(b"nobody's").cid, timeout=0.2)
    assert caught.value.code == "content-unavailable"
    assert leftovers(store.directory) == []


async def refused(
    store: Store, session: zenoh.Session, other: zenoh.Session, blocks: list[UnixfsBlock]
) -> tuple[str, int]:
    """The reason why a tree, the root last, is refused, and how many queries its holder got."""
    by_cid, count = {block.cid: block.data for block in blocks}, 0

    def give(query: zenoh.Query) -> None:
        nonlocal count
        count += 1
        query.reply(query.key_expr, by_cid[requested_cid(query)])

    with answer_queries(other, give):
        async with Exchange(session, store) as exchange:
            with pytest.raises(ContentCorrupt) as caught:
                await exchange.fetch(blocks[-1].cid, size_limit=1 << 20, timeout=10)
    assert leftovers(store.directory) == [], "what can never become a file is not kept"
    return caught.value.reason, count


async def test_a_root_with_too_many_links_is_refused(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    grain = leaf(b"x")
    reason, count = await refused(store, session, other_session, [grain, parent([(grain, 1)] * 30_000)])
    assert reason == "too-many-blocks"
    assert count == 1


async def test_a_tree_with_too_many_links_in_two_levels_is_refused(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    grain = leaf(b"x")
    branch = parent([(grain, 1)] * 900)
    reason, count = await refused(store, session, other_session, [grain, branch, parent([(branch, 900)] * 900)])
    assert reason == "too-many-blocks"
    assert count <= 3 * 8, "each of three blocks, by each of eight threads at most"


async def test_fetching_a_tree_that_is_too_deep_is_refused(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    chain = [leaf(b"x")]
    for _ in range(40):
        chain.append(parent([(chain[-1], 1)]))
    reason, count = await refused(store, session, other_session, chain)
    assert reason == "too-deep"
    assert count <= 13


async def test_an_oversized_block_is_refused(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    grain = leaf(b"x")
    link = write_bytes(1, b"\x12\x20" + digest(grain)) + write_bytes(2, bytes(1 << 20))
    data = write_number(1, 2) + write_number(3, 1) + write_number(4, 1)
    swollen = block_of(write_bytes(2, link) + write_bytes(1, data))
    reason, count = await refused(store, session, other_session, [grain, swollen])
    assert reason == "oversized-block"
    assert count == 1


async def test_a_file_over_the_quota_is_refused_by_its_root(
    tmp_path: Path, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = holder_store.put_bytes(sample_bytes(4 * CHUNK_SIZE))
    with Store(tmp_path / "small", quota=CHUNK_SIZE) as small:
        async with Exchange(other_session, holder_store) as holder, Exchange(session, small) as exchange:
            with raises_with(StoreFull, code="quota-reached"):
                await exchange.fetch(cid)
            assert holder.statistics().served == 1
        assert small.usage().bytes == 0
    assert leftovers(tmp_path / "small") == []

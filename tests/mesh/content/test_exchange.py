from __future__ import annotations

import asyncio
import io
import time
from typing import TYPE_CHECKING

import pytest

from mesh.content import ContentTooLarge, ContentUnavailable, Exchange, Store
from mesh.errors import ClosedError, InvalidCid
from schemas.keys import cid_selector
from schemas.unixfs import CHUNK_SIZE, blocks_of_stream, cid_of_bytes
from tests.support.content import answer_queries, sample_bytes, until_held
from tests.support.waiting import at_most, until

if TYPE_CHECKING:
    from pathlib import Path

    import zenoh

    from tests.support.routers import EmbeddedRouter


@pytest.mark.parametrize("size", [0, 1, CHUNK_SIZE, 5 * CHUNK_SIZE + 1, 175 * CHUNK_SIZE])
async def test_a_file_is_fetched_from_its_holder_and_then_served(
    tmp_path: Path, store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session, size: int
) -> None:
    data = sample_bytes(size)
    cid = holder_store.put_bytes(data)
    async with Exchange(other_session, holder_store), Exchange(session, store) as exchange:
        path = await exchange.fetch(cid)
        assert path.read_bytes() == data
        assert store.list() == (cid,)
        blocks = list(blocks_of_stream(io.BytesIO(data)))
        assert exchange.statistics().fetched_blocks == len(blocks)
        assert exchange.statistics().fetched_bytes == sum(len(block.data) for block in blocks)
        assert await exchange.fetch(cid) == path
        assert exchange.statistics().fetched_blocks == len(blocks)
    with Store(tmp_path / "third") as third_store:
        async with Exchange(session, store), Exchange(other_session, third_store) as third:
            assert (await third.fetch(cid)).read_bytes() == data


async def test_a_file_without_a_holder_is_unavailable_after_the_timeout(store: Store, session: zenoh.Session) -> None:
    cid = cid_of_bytes(b"nobody's")
    async with Exchange(session, store) as exchange:
        begin = time.monotonic()
        with pytest.raises(ContentUnavailable) as caught:
            await exchange.fetch(cid, timeout=0.3)
        assert time.monotonic() - begin >= 0.3
        assert caught.value.cid == cid
    assert store.list() == ()


async def test_an_invalid_cid_is_not_requested(store: Store, session: zenoh.Session) -> None:
    async with Exchange(session, store) as exchange:
        with pytest.raises(InvalidCid):
            await exchange.fetch("aira/cid/**")


async def test_a_holder_may_appear_late(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    async with Exchange(session, store) as exchange, Exchange(other_session, holder_store) as holder:
        fetching = asyncio.create_task(exchange.fetch(cid_of_bytes(b"late"), timeout=30))
        while not holder.statistics().missed:
            await asyncio.sleep(0.01)
        await asyncio.to_thread(holder_store.put_bytes, b"late")
        assert (await fetching).read_bytes() == b"late"


async def test_a_file_that_is_too_large_costs_one_block(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = holder_store.put_bytes(sample_bytes(4 * CHUNK_SIZE))
    async with Exchange(other_session, holder_store) as holder, Exchange(session, store) as exchange:
        with pytest.raises(ContentTooLarge) as caught:
            await exchange.fetch(cid, size_limit=4 * CHUNK_SIZE - 1)
        assert (caught.value.cid, caught.value.size) == (cid, 4 * CHUNK_SIZE)
        assert holder.statistics().served == 1
    assert store.list() == ()


async def test_queries_for_others_or_for_missing_blocks_get_no_reply(
    holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = holder_store.put_bytes(b"held")
    not_held = cid_of_bytes(b"not held")
    async with Exchange(other_session, holder_store) as holder:
        await until_held(session, cid, holders=1)
        served = holder.statistics().served
        for selector in (cid_selector(), cid_selector(cid=not_held), cid_selector("0x" + "ab" * 20, cid)):
            with at_most(5):
                replies = await asyncio.to_thread(session.get, selector, timeout=30.0)
                assert await asyncio.to_thread(list, replies) == []
        assert holder.statistics().served == served
        assert (holder.statistics().missed, holder.statistics().ignored) == (1, 1)


async def test_a_fetch_continues_with_another_holder(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    data = sample_bytes(30 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    blocks = {block.cid: block.data for block in blocks_of_stream(io.BytesIO(data))}
    given, refused = 0, 0

    def give_a_few(query: zenoh.Query) -> None:
        nonlocal given, refused
        if given < 12:
            given += 1
            query.reply(query.key_expr, blocks[str(query.key_expr).rpartition("/")[2]])
        else:
            refused += 1

    async with Exchange(session, store) as exchange:
        with answer_queries(other_session, give_a_few):
            fetching = asyncio.create_task(exchange.fetch(cid, timeout=600))
            await until(lambda: refused > 40, what="rounds of queries after the last block of this holder", seconds=60)
            fetching.cancel()
            with pytest.raises(asyncio.CancelledError):
                await fetching
        first = exchange.statistics().fetched_blocks
        async with Exchange(other_session, holder_store):
            assert (await exchange.fetch(cid)).read_bytes() == data
        second = exchange.statistics().fetched_blocks - first
    assert first == 12
    assert second == len(blocks) - first


async def test_a_cancelled_fetch_ends_and_can_be_repeated(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = cid_of_bytes(b"wanted")
    async with Exchange(session, store) as exchange, Exchange(other_session, holder_store) as holder:
        fetching = asyncio.create_task(exchange.fetch(cid, timeout=600))
        while not holder.statistics().missed:
            await asyncio.sleep(0.01)
        fetching.cancel()
        with at_most(5), pytest.raises(asyncio.CancelledError):
            await fetching
        await asyncio.to_thread(holder_store.put_bytes, b"wanted")
        assert (await exchange.fetch(cid)).read_bytes() == b"wanted"


async def test_a_slow_holder_is_accepted_while_blocks_arrive(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    data = sample_bytes(3 * CHUNK_SIZE)
    blocks = {block.cid: block.data for block in blocks_of_stream(io.BytesIO(data))}

    def answer_slowly(query: zenoh.Query) -> None:
        time.sleep(1.0)
        query.reply(query.key_expr, blocks[str(query.key_expr).rpartition("/")[2]])

    with answer_queries(other_session, answer_slowly):
        async with Exchange(session, store, width=1) as exchange:
            begin = time.monotonic()
            await exchange.fetch(cid_of_bytes(data), timeout=3.5)
            assert time.monotonic() - begin > 3.5


async def test_concurrent_fetches_of_one_file_download_it_once(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = holder_store.put_bytes(sample_bytes(8 * CHUNK_SIZE))
    async with Exchange(other_session, holder_store) as holder, Exchange(session, store) as exchange:
        paths = await asyncio.gather(*(exchange.fetch(cid) for _ in range(5)))
        assert set(paths) == {store.path(cid)}
        assert exchange.statistics().fetched_blocks == 9
        assert holder.statistics().served == 9


async def test_closing_the_exchange_ends_its_fetches(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    async with Exchange(other_session, holder_store) as holder:
        async with Exchange(session, store) as exchange:
            fetching = asyncio.create_task(exchange.fetch(cid_of_bytes(b"never"), timeout=600))
            while not holder.statistics().missed:
                await asyncio.sleep(0.01)
        with pytest.raises(ClosedError):
            await fetching
        with pytest.raises(ClosedError):
            await exchange.__aenter__()


async def test_a_fetch_outlives_a_restart_of_the_router(
    store: Store, holder_store: Store, router: EmbeddedRouter, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    async with Exchange(session, store) as exchange, Exchange(other_session, holder_store) as holder:
        fetching = asyncio.create_task(exchange.fetch(cid_of_bytes(b"later"), timeout=60))
        while not holder.statistics().missed:
            await asyncio.sleep(0.01)
        await asyncio.to_thread(router.stop)
        await asyncio.to_thread(holder_store.put_bytes, b"later")
        await asyncio.to_thread(router.start)
        assert (await fetching).read_bytes() == b"later"


async def test_closing_the_session_first_ends_the_exchange(
    store: Store, router: EmbeddedRouter, session: zenoh.Session
) -> None:
    async with Exchange(session, store) as exchange:
        session.close()  # type: ignore[no-untyped-call]
        with pytest.raises(ClosedError):
            await exchange.fetch(cid_of_bytes(b"never"), timeout=60)

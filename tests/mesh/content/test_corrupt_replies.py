from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from mesh.content import ContentCorrupt, DownloadTiming, Exchange, Store
from schemas.keys import cid_selector
from schemas.unixfs import CHUNK_SIZE, cid_of_bytes
from tests.support.content import answer_queries, holder_of, sample_bytes
from tests.support.waiting import until

if TYPE_CHECKING:
    import zenoh


async def test_a_corrupt_reply_is_counted_by_sender_and_another_holder_used(
    store: Store,
    holder_store: Store,
    session: zenoh.Session,
    other_session: zenoh.Session,
    third_session: zenoh.Session,
) -> None:
    data = sample_bytes(3 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    sent = 0

    def send_corrupt(query: zenoh.Query) -> None:
        nonlocal sent
        query.reply(query.key_expr, b"not what was asked for")
        sent += 1

    with answer_queries(third_session, send_corrupt):
        async with Exchange(session, store) as exchange:
            # At first this is the only holder, so that its reply is used.
            fetching = asyncio.create_task(exchange.fetch(cid))
            while not sent:
                await asyncio.sleep(0.01)
            async with Exchange(other_session, holder_store):
                assert (await fetching).read_bytes() == data
            corrupt = exchange.statistics().corrupt_blocks
    assert list(corrupt) == [holder_of(third_session)]
    assert corrupt[holder_of(third_session)] >= 1


async def test_a_holder_that_sends_corrupt_parts_is_replaced_by_another(
    store: Store,
    holder_store: Store,
    session: zenoh.Session,
    other_session: zenoh.Session,
    third_session: zenoh.Session,
) -> None:
    data = sample_bytes(20 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    root = holder_store.get_block(cid)
    assert root is not None
    true_root = root
    sent = asyncio.Event()
    loop = asyncio.get_running_loop()

    def send_corrupt_parts(query: zenoh.Query) -> None:
        if str(query.key_expr).endswith(cid):
            query.reply(query.key_expr, true_root)
        else:
            query.reply(query.key_expr, true_root[:-1])
            loop.call_soon_threadsafe(sent.set)

    with answer_queries(third_session, send_corrupt_parts):
        async with Exchange(session, store) as exchange:
            fetching = asyncio.create_task(exchange.fetch(cid))
            await sent.wait()
            async with Exchange(other_session, holder_store):
                assert (await fetching).read_bytes() == data
            assert holder_of(third_session) in exchange.statistics().corrupt_blocks


async def test_if_all_replies_are_corrupt_the_error_names_their_senders(
    store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    cid = cid_of_bytes(b"true")
    with answer_queries(other_session, lambda query: query.reply(query.key_expr, bytes(3 << 20))):
        async with Exchange(session, store) as exchange:
            with pytest.raises(ContentCorrupt) as caught:
                await exchange.fetch(cid, timeout=5)
    assert caught.value.cid == cid
    assert caught.value.holders == (holder_of(other_session),)
    assert store.list() == ()


async def test_a_silent_holder_does_not_delay_another(
    store: Store,
    holder_store: Store,
    session: zenoh.Session,
    other_session: zenoh.Session,
    third_session: zenoh.Session,
) -> None:
    data = sample_bytes(10 * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    kept: list[zenoh.Query] = []
    silent = third_session.declare_queryable(cid_selector(), kept.append)
    async with Exchange(session, store, timing=DownloadTiming(query_timeout=0.2)) as exchange:
        # At first the silent one is the only holder, so that it is asked and waited for.
        fetching = asyncio.create_task(exchange.fetch(cid, timeout=600))
        await until(lambda: kept, what="a query", seconds=30)
        async with Exchange(other_session, holder_store):
            path = await asyncio.wait_for(fetching, 60)
        assert path.read_bytes() == data
    silent.undeclare()  # type: ignore[no-untyped-call]
    kept.clear()

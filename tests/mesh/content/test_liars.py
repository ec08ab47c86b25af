"""Sessions that answer every query with lies do not keep a file from those who ask for it."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.base.flood import Drops
from mesh.base.retry import RetryPolicy
from mesh.content import DownloadTiming, Exchange, Store
from mesh.content._exchange import LIE, Liars, Replier
from schemas.unixfs import CHUNK_SIZE
from tests.support.clocks import SECOND, SetClock
from tests.support.content import sample_bytes, until_held
from tests.support.routers import EmbeddedRouter, client_config

if TYPE_CHECKING:
    from collections.abc import Iterator

LIES = 65
"""Lies that a liar sends for each query."""
BLOCKS = 12
TWICE = DownloadTiming(retry=RetryPolicy(initial=0.01, factor=1.0, ceiling=0.01, attempts=2))
"""Two attempts at a block, and no more."""


class Liar:
    """A session that answers every query on the mesh with lies, in the name of `agent` if the query names none."""

    def __init__(self, endpoint: str, agent: str = "0x" + "ab" * 20) -> None:
        self.asked = 0
        self._agent = agent
        self.session = zenoh.open(client_config(endpoint))
        self._queryable = self.session.declare_queryable("aira/**", self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        self.asked += 1
        with query:
            for number in range(LIES):
                query.reply(str(query.key_expr).replace("*", self._agent), f"lie {number}")


@pytest.fixture
def liars(router: EmbeddedRouter) -> Iterator[list[Liar]]:
    with ExitStack() as stack:
        found = [Liar(router.endpoint) for _ in range(3)]
        for liar in found:
            stack.enter_context(liar.session)
        yield found


async def test_liars_do_not_use_up_the_replies_to_a_query(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session, liars: list[Liar]
) -> None:
    data, drops = sample_bytes(BLOCKS * CHUNK_SIZE), Drops()
    cid = holder_store.put_bytes(data)
    async with (
        Exchange(other_session, holder_store) as holder,
        Exchange(session, store, timing=TWICE, drops=drops) as exchange,
    ):
        await until_held(session, cid, holders=1 + len(liars) * LIES)
        served = holder.statistics().served

        assert (await exchange.fetch(cid)).read_bytes() == data

        assert holder.statistics().served - served == BLOCKS + 1, "no block was requested twice"
    assert sum(exchange.statistics().corrupt_blocks.values()) <= len(liars), "after its first lie a session is ignored"
    assert drops.totals()[LIE] >= len(liars) * LIES
    assert {name.partition("@")[2] for name, _ in drops.heaviest(LIE)} == {str(liar.session.zid()) for liar in liars}


async def test_a_liar_in_an_honest_session_s_name_does_not_silence_it(
    store: Store, holder_store: Store, session: zenoh.Session, other_session: zenoh.Session
) -> None:
    data = sample_bytes(BLOCKS * CHUNK_SIZE)
    cid = holder_store.put_bytes(data)
    async with Exchange(other_session, holder_store), Exchange(session, store, timing=TWICE) as exchange:
        await until_held(session, cid, holders=1)
        exchange._liars.add(Replier("", str(other_session.zid())))

        assert (await exchange.fetch(cid)).read_bytes() == data


def test_lies_are_remembered_for_a_while_and_by_a_bounded_number_of_sessions() -> None:
    clock, drops = SetClock(), Drops()
    liars = Liars(drops, clock=clock)

    assert liars.add(Replier("0x01", "aa"))
    assert not liars.add(Replier("0x02", "aa")), "the session is known"
    assert Replier("", "aa") in liars
    assert Replier("0x01", "bb") not in liars, "an address alone may be anybody's"

    clock.pass_by(61 * SECOND)
    assert Replier("", "aa") not in liars

    for number in range(2000):
        liars.add(Replier("", str(number)))
    assert sum(Replier("", str(number)) in liars for number in range(2000)) == 1024
    assert drops.totals() == {LIE: 2002}

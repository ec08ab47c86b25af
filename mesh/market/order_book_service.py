"""Answers queries for the open orders of a market, which a client sends after it has subscribed."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.network import call_in_loop, verified_key
from schemas import encode, lighthouse_selector

if TYPE_CHECKING:
    from concurrent.futures import Future

    from mesh.market.book import Order, OrderBook
    from schemas import Verified

THREADS: Final = 2
"""Threads that answer: a book can be large, and a client may take the answers slowly."""
PENDING: Final = 64
"""Queries that may be pending, each with a copy of the list of orders; further ones are dropped."""


class OrderBookService:
    """Answers queries on the keys of `lighthouse` (ENS name) from its `book`, inside `async with`.

    At most `limit` queries are pending at a time. Leaving `async with` aborts the answers.
    """

    def __init__(
        self,
        session: zenoh.Session,
        lighthouse: str,
        book: OrderBook,
        *,
        limit: int = PENDING,
        threads: ThreadPoolExecutor | None = None,
    ) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._book = book
        self._limit = limit
        self._threads = threads or ThreadPoolExecutor(THREADS, thread_name_prefix="order book")
        self._answers: set[Future[None]] = set()
        self._open = True

    @property
    def pending(self) -> int:
        """The number of queries that are being answered or wait for it."""
        return len(self._answers)

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            lighthouse_selector(self._lighthouse), lambda query: call_in_loop(loop, self.answer, query), complete=True
        )
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._open = False
        if not self._session.is_closed():
            self._queryable.undeclare()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def answer(self, query: zenoh.Query) -> None:
        """Answer a query in a thread, or drop it. Call it in the event loop's thread, where the book changes."""
        if self._open and len(self._answers) < self._limit:
            answer = self._threads.submit(self._reply, query, list(self._book.orders()))
            self._answers.add(answer)
            answer.add_done_callback(self._answers.discard)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _reply(self, query: zenoh.Query, orders: list[Verified[Order]]) -> None:
        with query:  # leaving it ends the answer
            for order in orders:
                key = verified_key(self._lighthouse, order)
                if not self._open:
                    return
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, encode(order.message), encoding="application/json")

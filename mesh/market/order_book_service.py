"""The market's memory: who comes late asks for the open orders, and the order book answers."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from mesh.network import call_in_loop, verified_key
from schemas import encode, lighthouse_selector

if TYPE_CHECKING:
    from types import TracebackType

    from mesh.market.book import Order, OrderBook
    from schemas import Verified

ANSWERERS: Final = 2
"""Threads that answer: a market can be large, and who asks may be slow to take the answers."""
QUESTIONS: Final = 64
"""Questions that are answered or wait for it, each with a list of the book as it was; more are turned down."""


class OrderBookService:
    """Answers queries on the keys of a lighthouse from its `book`, inside `async with`.

    `lighthouse` is the ENS name. Leaving `async with` breaks off what is not answered yet.
    """

    def __init__(self, session: zenoh.Session, lighthouse: str, book: OrderBook) -> None:
        self._session = session
        self._lighthouse = lighthouse
        self._book = book
        self._room = threading.Semaphore(QUESTIONS)
        self._threads = ThreadPoolExecutor(ANSWERERS, thread_name_prefix="market memory")
        self._open = True

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._queryable: Any = self._session.declare_queryable(
            lighthouse_selector(self._lighthouse),
            lambda query: call_in_loop(loop, self._answer_soon, query),
            complete=True,
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        if not self._session.is_closed():
            self._queryable.undeclare()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _answer_soon(self, query: zenoh.Query) -> None:
        """On the loop's thread, as the book changes there."""
        if self._open and self._room.acquire(blocking=False):
            answering = self._threads.submit(self._answer, query, list(self._book.orders()))
            answering.add_done_callback(lambda done: self._room.release())
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def _answer(self, query: zenoh.Query, orders: list[Verified[Order]]) -> None:
        """Leaving `with` tells the asker that this was all."""
        with query:
            for order in orders:
                key = verified_key(self._lighthouse, order)
                if not self._open:
                    return
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, encode(order.message), encoding="application/json")

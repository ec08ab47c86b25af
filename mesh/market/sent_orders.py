"""The orders whose transactions may still be mined, on disk: a provider that is restarted knows them."""

from __future__ import annotations

from contextlib import AsyncExitStack, contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from mesh.work.database import Database, LedgerUnusable

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_SCHEMA: Final = "CREATE TABLE IF NOT EXISTS sent (identity BLOB PRIMARY KEY, lasting TEXT, signer TEXT) WITHOUT ROWID;"


class SentOrder(NamedTuple):
    """An order (`order_id`) with what its versions share (`lasting_hash`, signer)."""

    identity: bytes
    lasting: str
    signer: str


class SentOrders:
    """The file of sent orders: `async with SentOrders(path) as sent`; without `path` nothing is kept.

    Raises `TransactionsNotKept` if the file can't be read or written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.left: tuple[SentOrder, ...] = ()
        """What an earlier process has left."""
        self._database = None if path is None else Database(path, _SCHEMA)
        self._kept: set[bytes] = set()

    async def __aenter__(self) -> Self:
        if self._database is not None:
            with self._on_disk():
                await self._database.open()
                async with AsyncExitStack() as stack:
                    stack.push_async_callback(self._database.close)
                    rows = await self._database.rows("SELECT identity, lasting, signer FROM sent")
                    stack.pop_all()
            self.left = tuple(SentOrder(*row) for row in rows)
            self._kept = {one.identity for one in self.left}
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._database is not None:
            await self._database.close()

    async def add(self, orders: Sequence[SentOrder]) -> None:
        """Keep orders, before their transaction is sent."""
        new = [order for order in orders if order.identity not in self._kept]
        await self._write("INSERT OR REPLACE INTO sent VALUES (?, ?, ?)", new)
        self._kept.update(order.identity for order in new)

    async def remove(self, identities: Sequence[bytes]) -> None:
        """Forget orders whose transactions can't be mined any more."""
        self._kept.difference_update(identities)  # first, so that one that is sent again meanwhile is written again
        await self._write("DELETE FROM sent WHERE identity = ?", [(identity,) for identity in identities])

    async def _write(self, statement: str, rows: Sequence[tuple[object, ...]]) -> None:
        if self._database is not None and rows:
            with self._on_disk():
                await self._database.run_together(*((statement, row) for row in rows))

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except LedgerUnusable as error:
            from mesh.chain.errors import TransactionsNotKept  # needs the extra `chain`; agents load this module

            raise TransactionsNotKept(error.path, error.why) from None

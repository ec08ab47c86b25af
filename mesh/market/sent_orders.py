"""The orders of a provider's transactions, on disk: those that may still be mined, and those that became contracts.

A provider that is restarted knows the latter until their deadline: other versions of them may be valid.
"""

from __future__ import annotations

from contextlib import AsyncExitStack, contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from mesh.work.database import Database, LedgerUnusable

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

_SCHEMA: Final = """
    CREATE TABLE IF NOT EXISTS sent_orders (
        identity BLOB PRIMARY KEY, lasting TEXT, signer TEXT, deadline INTEGER, is_contract INTEGER NOT NULL DEFAULT 0
    ) WITHOUT ROWID;
"""
_LATEST: Final = 2**63 - 1
"""The latest deadline that SQLite can keep."""


class SentOrder(NamedTuple):
    """An order (`order_id`) with what its versions share (`lasting_hash`, signer, deadline)."""

    identity: bytes
    lasting: str
    signer: str
    deadline: int


class SentOrders:
    """The file of sent orders: `async with SentOrders(path) as sent`; without `path` nothing is kept.

    Raises `TransactionsNotKept` if the file can't be read or written.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.left: tuple[SentOrder, ...] = ()
        """What an earlier process has left, and may still be mined."""
        self.contracts: tuple[SentOrder, ...] = ()
        """The orders of that process that became contracts."""
        self._database = None if path is None else Database(path, _SCHEMA)
        self._kept: set[bytes] = set()

    async def __aenter__(self) -> Self:
        if self._database is not None:
            with self._on_disk():
                await self._database.open()
                async with AsyncExitStack() as stack:
                    stack.push_async_callback(self._database.close)
                    statement = "SELECT identity, lasting, signer, deadline, is_contract FROM sent_orders"
                    rows = await self._database.rows(statement)
                    stack.pop_all()
            self.left = tuple(SentOrder(*row) for *row, is_contract in rows if not is_contract)
            self.contracts = tuple(SentOrder(*row) for *row, is_contract in rows if is_contract)
            self._kept = {one.identity for one in self.left}
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._database is not None:
            await self._database.close()

    async def add(self, orders: Sequence[SentOrder]) -> None:
        """Keep orders, before their transaction is sent."""
        new = [order for order in orders if order.identity not in self._kept]
        statement = "INSERT OR REPLACE INTO sent_orders (identity, lasting, signer, deadline) VALUES (?, ?, ?, ?)"
        await self._write(*((statement, one._replace(deadline=min(one.deadline, _LATEST))) for one in new))
        self._kept.update(order.identity for order in new)

    async def remove(self, identities: Sequence[bytes], *, contracts: Collection[bytes] = (), head: int = 0) -> None:
        """Forget orders whose transactions can't be mined any more, but keep the `contracts` among them as such.

        Contracts with a deadline not after block `head` are forgotten, too.
        """
        if not identities:
            return
        self._kept.difference_update(identities)  # first, so that one that is sent again meanwhile is written again
        keep, forget = "UPDATE sent_orders SET is_contract = 1", "DELETE FROM sent_orders"
        await self._write(
            *((f"{keep if one in contracts else forget} WHERE identity = ?", (one,)) for one in identities),
            (f"{forget} WHERE is_contract AND deadline <= ?", (head,)),
        )

    async def _write(self, *statements: tuple[str, tuple[object, ...]]) -> None:
        if self._database is not None and statements:
            with self._on_disk():
                await self._database.run_together(*statements)

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except LedgerUnusable as error:
            from mesh.chain.errors import TransactionsNotKept  # needs the extra `chain`; agents load this module

            raise TransactionsNotKept(error.path, error.why) from None

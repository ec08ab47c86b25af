"""The one file of a provider in a market: what must outlive a crash, in SQLite. A bridge keeps withdrawals in one.

It has the withdrawals that are known, the orders of transactions that may still be mined, those that became
contracts (whose other versions may be valid until their deadline), how many free contracts are left, and which open
contracts it has created with a permit.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Self

from mesh.base.database import DISK_ERRORS, SyncedDatabase, transactions_not_kept
from mesh.market._orders import SentOrder

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.market._orders import SettledOrders

_SCHEMA: Final = """
    CREATE TABLE IF NOT EXISTS withdrawals (
        identity BLOB PRIMARY KEY, signer TEXT NOT NULL, payload BLOB NOT NULL, lasting INTEGER NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE IF NOT EXISTS sent_orders (
        identity BLOB PRIMARY KEY, lasting TEXT NOT NULL, signer TEXT NOT NULL, deadline INTEGER NOT NULL,
        is_contract INTEGER NOT NULL DEFAULT 0
    ) WITHOUT ROWID;
    CREATE TABLE IF NOT EXISTS free_contracts (
        row INTEGER PRIMARY KEY CHECK (row = 0), "left" REAL NOT NULL, at REAL NOT NULL
    );
    CREATE TABLE IF NOT EXISTS permitted (liability TEXT PRIMARY KEY) WITHOUT ROWID;
"""
_LATEST: Final = 2**63 - 1
"""The latest deadline that SQLite can keep."""


class MarketStore(SyncedDatabase):
    """The file at `path`, between `open` and `close` or in a `with` block; without `path` nothing is kept.

    What is about orders and free contracts raises `ConfigurationError`, as the `with` block does; the rest
    `DISK_ERRORS`.
    """

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path, _SCHEMA)
        self._kept: set[bytes] = set()
        """The orders of transactions that are in the file."""

    def __enter__(self) -> Self:
        with self._needed():
            try:
                self.open()
                self._kept = {one.identity for one in self.sent_orders()}
            except BaseException:
                self.close()
                raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def sent_orders(self, *, contracts: bool = False) -> list[SentOrder]:
        """The orders of transactions that may still be mined; or those that became `contracts`."""
        statement = "SELECT identity, lasting, signer, deadline FROM sent_orders WHERE is_contract = ?"
        return [SentOrder(*row) for row in self.rows(statement, (contracts,))]

    async def keep_sent(self, orders: Iterable[SentOrder]) -> None:
        """Have orders on the disk, before their transaction is sent."""
        new = [one._replace(deadline=min(one.deadline, _LATEST)) for one in orders if one.identity not in self._kept]
        statement = "INSERT OR REPLACE INTO sent_orders (identity, lasting, signer, deadline) VALUES (?, ?, ?, ?)"
        with self._needed():
            if new:
                self.write((statement, new))
                self._kept.update(one.identity for one in new)
            await self.sync()  # perhaps what another task has written, and waits for

    def settle_sent(self, settled: SettledOrders, head: int) -> None:
        """Forget orders whose transactions can't be mined any more, and contracts with a deadline up to block `head`.

        A power failure may take this back.
        """
        if not settled.forgotten and not settled.contracts:
            return
        with self._needed():
            self.write(
                ("DELETE FROM sent_orders WHERE identity = ?", zip(settled.forgotten)),
                ("UPDATE sent_orders SET is_contract = 1 WHERE identity = ?", zip(settled.contracts)),
                ("DELETE FROM sent_orders WHERE is_contract AND deadline <= ?", [(head,)]),
            )
        self._kept.difference_update(settled.forgotten, settled.contracts)

    def free_contracts(self) -> tuple[float, float] | None:
        """How many free contracts the earlier process had left, and when (seconds since 1970)."""
        return next(map(tuple, self.rows('SELECT "left", at FROM free_contracts')), None)

    async def keep_free_contracts(self, left: float, at: float) -> None:
        """Have on the disk how many free contracts are left at a time."""
        with self._needed():
            self.write(("INSERT OR REPLACE INTO free_contracts VALUES (0, ?, ?)", [(left, at)]))
            await self.sync()

    def permitted(self) -> list[str]:
        """The contracts (addresses) that were created with a permit, and had not ended when that was noted last."""
        return [address for (address,) in self.rows("SELECT liability FROM permitted")]

    def keep_permitted(self, liability: str) -> None:
        """Note that a contract was created with a permit. A power failure may take this back."""
        with self._needed():
            self.write(("INSERT OR REPLACE INTO permitted VALUES (?)", [(liability,)]))

    def forget_permitted(self, liability: str) -> None:
        """Forget such a contract, which has ended."""
        with self._needed():
            self.write(("DELETE FROM permitted WHERE liability = ?", [(liability,)]))

    @contextmanager
    def _needed(self) -> Iterator[None]:
        """Without this on the disk no transaction is sent."""
        try:
            yield
        except DISK_ERRORS as error:
            raise transactions_not_kept(self.path, error) from None

"""What a provider keeps of a market: its one SQLite file. A bridge keeps withdrawals in one.

It has what must outlive a crash: the withdrawals that are known, the orders of transactions that may still be mined,
those that became contracts (whose other versions may be valid until their deadline), how many free contracts are left,
and which open contracts it has created with a permit. `Withdrawals` are known until their deadline has passed, also
across a restart.
"""

from __future__ import annotations

import logging
from bisect import bisect_right, insort
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from mesh.base.database import DISK_ERRORS, SyncedDatabase, transactions_not_kept
from mesh.base.flood import Rate, RateLimiter
from mesh.base.outage_log import OutageLog
from mesh.errors import AiraError
from mesh.market._orders import SentOrder
from mesh.settings.groups import DEADLINE_LIMIT
from schemas import InvalidMessage, Verified, Withdrawal, address_bytes, decode, encode
from schemas.messages import message_hash

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.market._orders import SettledOrders

log = logging.getLogger(__name__)

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


class WithdrawalLimits(NamedTuple):
    """How many withdrawals are kept, and at which rate new ones are."""

    kept: int = 16_384
    """In all; about 15 MB, and what an answer to a query holds."""
    of_signer: int = 1024
    """Of one signer."""
    rate: Rate = Rate(per_second=200.0, burst=kept)
    """New ones, of orders that the book does not hold. Each is written to the disk."""
    rate_of_signer: Rate = Rate(per_second=20.0, burst=of_signer)
    """The same of one signer."""


WITHDRAWAL_LIMITS: Final = WithdrawalLimits()


def withdrawn_id(withdrawal: Verified[Withdrawal]) -> bytes:
    """The identity of the order that a withdrawal concerns, as `mesh.market.book.order_id` has it."""
    return bytes.fromhex(withdrawal.message.order) + address_bytes(withdrawal.signer)


@dataclass(slots=True)
class _Known:
    """A withdrawal; `is_lasting` if it is not forgotten before its deadline.

    `write` is the number of its write in the store, 0 if it could not be written.
    """

    withdrawal: Verified[Withdrawal]
    is_lasting: bool
    write: int = 0


class Withdrawals:
    """The known withdrawals: `with Withdrawals(store) as withdrawals`; in memory only if the store has no path.

    It opens the store, if that is not open, and goes on without it if it can't.

    At most `limits.kept` are known. Those of open orders are never forgotten before their deadline, nor are others
    while that leaves half of the places, or three quarters if the deadline is further away than `deadline_limit`
    blocks: these may be promised. Strangers can sign any number, so of the rest those with the latest deadline are
    forgotten when there are too many: honest orders end soon. A failing disk is logged as an outage.
    """

    def __init__(
        self,
        store: MarketStore | None = None,
        *,
        limits: WithdrawalLimits = WITHDRAWAL_LIMITS,
        deadline_limit: int = DEADLINE_LIMIT,
    ) -> None:
        self._store = store or MarketStore()
        self._limits = limits
        self._deadline_limit = deadline_limit
        self._head = 0
        self._rate = RateLimiter(per_sender=limits.rate_of_signer, total=limits.rate)
        self._known: dict[bytes, _Known] = {}
        self._lasting: list[tuple[int, bytes]] = []
        """Deadline and order of those that are not forgotten before, the earliest first."""
        self._brief: list[tuple[int, bytes]] = []
        """The same of the others."""
        self._by_signer: Counter[str] = Counter()
        self._by_order: dict[str, dict[bytes, Verified[Withdrawal]]] = {}
        self._outage = OutageLog(log, "withdrawals")

    def __enter__(self) -> Self:
        self._opened = not self._store.is_open
        try:
            if self._opened:
                self._store.open()
            rows = self._store.rows("SELECT identity, signer, payload, lasting FROM withdrawals")
        except DISK_ERRORS as error:
            self._failed(error)
            rows = []
        for identity, signer, payload, lasting in rows:
            try:
                message = decode(payload)
            except InvalidMessage as error:
                self._failed(error)
                continue
            if isinstance(message, Withdrawal):
                verified = Verified(message, message_hash(message), signer)
                if (known := self._take(identity, verified, is_lasting=bool(lasting))) is not None:
                    known.write = self._store.written
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._opened:
            self._store.close()

    def __contains__(self, order: object) -> bool:
        """Whether the order with this identity is withdrawn."""
        return order in self._known

    def __len__(self) -> int:
        return len(self._known)

    def __iter__(self) -> Iterator[Verified[Withdrawal]]:
        return iter([known.withdrawal for known in self._known.values()])

    def add(self, withdrawal: Verified[Withdrawal], *, is_open: bool = False) -> bool:
        """Know a withdrawal until its deadline; False if there is no room for it, or it is one too many for now.

        The latter not if its order `is_open`: one that a stranger can't have made up. One per order is kept. One that
        could not be written is written when it is added again.
        """
        identity = withdrawn_id(withdrawal)
        if (known := self._known.get(identity)) is None:
            if not (is_open or self._rate.allow(withdrawal.signer)):
                return False
            is_soon = withdrawal.message.deadline <= self._head + self._deadline_limit
            is_lasting = is_open or len(self._lasting) < self._limits.kept // (2 if is_soon else 4)
            if (known := self._take(identity, withdrawal, is_lasting=is_lasting)) is None:
                return False
        if not known.write:
            row = identity, withdrawal.signer, encode(withdrawal.message), known.is_lasting
            is_written = self._write("INSERT OR REPLACE INTO withdrawals VALUES (?, ?, ?, ?)", [row])
            known.write = self._store.written if is_written else 0
        return True

    async def sync(self) -> None:
        """Wait until all that was added so far is on the disk, also after a power failure."""
        try:
            await self._store.sync()
        except OSError as error:
            self._failed(error)

    def of(self, order: str) -> list[Verified[Withdrawal]]:
        """The withdrawals of the orders with this hash (64 hexadecimal digits), one of each signer."""
        return list(self._by_order.get(order, {}).values())

    def is_kept(self, order: bytes) -> bool:
        """Whether the withdrawal of the order with this identity is known until its deadline, whatever fails."""
        known = self._known.get(order)
        return known is not None and known.is_lasting and 0 < known.write <= self._store.synced

    def expire(self, head: int) -> None:
        """Forget the withdrawals whose deadline is not after block `head`: their orders have expired, too."""
        self._head = head
        for due in (self._lasting, self._brief):
            if count := bisect_right(due, head, key=lambda one: one[0]):
                self._forget(due[:count])
                del due[:count]

    def _take(self, identity: bytes, withdrawal: Verified[Withdrawal], *, is_lasting: bool) -> _Known | None:
        due = withdrawal.message.deadline, identity
        if self._by_signer[withdrawal.signer] >= self._limits.of_signer:
            return None
        if len(self._known) >= self._limits.kept:
            if not self._brief or not (is_lasting or due < self._brief[-1]):
                return None
            self._forget([self._brief.pop()])
        known = self._known[identity] = _Known(withdrawal, is_lasting)
        self._by_order.setdefault(withdrawal.message.order, {})[identity] = withdrawal
        self._by_signer[withdrawal.signer] += 1
        insort(self._lasting if is_lasting else self._brief, due)
        return known

    def _forget(self, due: list[tuple[int, bytes]]) -> None:
        for _, identity in due:
            forgotten = self._known.pop(identity).withdrawal
            signer, order = forgotten.signer, forgotten.message.order
            del self._by_order[order][identity]
            if not self._by_order[order]:
                del self._by_order[order]
            self._by_signer[signer] -= 1
            if not self._by_signer[signer]:
                del self._by_signer[signer]
        self._write("DELETE FROM withdrawals WHERE identity = ?", [(identity,) for _, identity in due])

    def _write(self, statement: str, rows: list[tuple[object, ...]]) -> bool:
        try:
            self._store.write((statement, rows))
        except DISK_ERRORS as error:
            self._failed(error)
            return False
        self._outage.recovered("withdrawals are kept on disk again")
        return True

    def _failed(self, error: Exception) -> None:
        failure = AiraError(
            f"withdrawals can't be kept in {self._store.path}: {error}",
            hint="free space on the disk, or let this user write there; a damaged file can be deleted",
            code="withdrawals-not-kept",
        )
        self._outage.failed(failure, "withdrawals are known until the process ends")

"""The withdrawals that a provider or a bridge knows: kept until their deadline has passed, also across a restart."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
from bisect import bisect_left, bisect_right, insort
from collections import Counter
from typing import TYPE_CHECKING, Final, Self

from mesh.content.files import sync_directory, sync_file
from mesh.errors import AiraError
from mesh.flood import Rate, RateLimiter
from mesh.outage_log import OutageLog
from mesh.private_files import make_private_database, make_private_folder
from mesh.settings.groups import DEADLINE_LIMIT
from schemas import InvalidMessage, Verified, Withdrawal, address_bytes, decode, encode
from schemas.wire import message_hash

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

log = logging.getLogger(__name__)

LIMIT: Final = 16_384
"""Withdrawals that are kept, at most; about 15 MB, and what an answer to a query holds."""
LIMIT_PER_SIGNER: Final = 1024
PER_SIGNER: Final = Rate(per_second=20.0, burst=LIMIT_PER_SIGNER)
"""Withdrawals of one signer's orders that the book does not hold. Each is written to the disk."""
IN_TOTAL: Final = Rate(per_second=200.0, burst=LIMIT)
"""The same of all signers."""
_TABLE: Final = """
    PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL;
    CREATE TABLE IF NOT EXISTS withdrawals (identity BLOB PRIMARY KEY, signer TEXT, payload BLOB) WITHOUT ROWID;
"""
_LASTING: Final = """
    BEGIN; ALTER TABLE withdrawals ADD COLUMN lasting INTEGER NOT NULL DEFAULT 1; PRAGMA user_version = 1; COMMIT;
"""


class WithdrawalsNotKept(AiraError, code="withdrawals-not-kept"):
    """Withdrawals can't be read or written on disk; those that arrive are known until the process ends."""

    def __init__(self, path: Path, why: object) -> None:
        super().__init__(
            f"withdrawals can't be kept in {path}: {why}",
            hint="free space on the disk, or let this user write there; a damaged file can be deleted",
        )
        self.path = path
        self.why = str(why)


def withdrawn_id(withdrawal: Verified[Withdrawal]) -> bytes:
    """The identity of the order that a withdrawal concerns, as `mesh.market.book.order_id` has it."""
    return bytes.fromhex(withdrawal.message.order) + address_bytes(withdrawal.signer)


class Withdrawals:
    """The known withdrawals: `with Withdrawals(path) as withdrawals`; in memory only if `path` is None.

    At most `limit` are known. Those of open orders are never forgotten before their deadline, nor are others while that
    leaves half of the places, or three quarters if the deadline is further away than `deadline_limit` blocks: these may
    be promised. Strangers can sign any number, so of the rest those with the latest deadline are forgotten when there
    are too many: honest orders end soon. Writes take tens of microseconds and run on the event loop, while `sync` waits
    for the disk in a thread. A failing disk is logged as an outage.
    """

    def __init__(
        self,
        path: Path | None = None,
        *,
        limit: int = LIMIT,
        limit_per_signer: int = LIMIT_PER_SIGNER,
        deadline_limit: int = DEADLINE_LIMIT,
        rate: Rate = IN_TOTAL,
    ) -> None:
        self._path = path
        self._limit = limit
        self._deadline_limit = deadline_limit
        self._head = 0
        self._limit_per_signer = limit_per_signer
        self._rate = RateLimiter(per_sender=PER_SIGNER, total=rate)
        self._known: dict[bytes, Verified[Withdrawal]] = {}
        self._lasting: list[tuple[int, bytes]] = []
        """Deadline and order of those that are not forgotten before, the earliest first."""
        self._brief: list[tuple[int, bytes]] = []
        """The same of the others."""
        self._by_signer: Counter[str] = Counter()
        self._unwritten: set[bytes] = set()
        """Orders whose withdrawal could not be written."""
        self._unsynced: set[bytes] = set()
        """Orders whose withdrawal was written, but that a power failure may take back."""
        self._syncing = asyncio.Lock()
        self._by_order: dict[str, dict[bytes, Verified[Withdrawal]]] = {}
        self._outage = OutageLog(log, "withdrawals")
        self._database: sqlite3.Connection | None = None

    def __enter__(self) -> Self:
        if self._path is not None:
            try:
                make_private_folder(self._path.parent)
                make_private_database(self._path)
                self._database = sqlite3.connect(self._path, timeout=0.1, isolation_level=None, check_same_thread=False)
                self._database.executescript(_TABLE)
                if not self._database.execute("PRAGMA user_version").fetchone()[0]:
                    self._database.executescript(_LASTING)
            except (OSError, sqlite3.Error) as error:
                self._failed(error)
            self._load()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._database is not None:
            self._database.close()

    def __contains__(self, order: bytes) -> bool:
        """Whether the order with this identity is withdrawn."""
        return order in self._known

    def __len__(self) -> int:
        return len(self._known)

    def __iter__(self) -> Iterator[Verified[Withdrawal]]:
        return iter(tuple(self._known.values()))

    def add(self, withdrawal: Verified[Withdrawal], *, is_open: bool = False) -> bool:
        """Know a withdrawal until its deadline; False if there is no room for it, or it is one too many for now.

        The latter not if its order `is_open`: one that a stranger can't have made up. One per order is kept. One that
        could not be written is written when it is added again.
        """
        identity = withdrawn_id(withdrawal)
        is_known = identity in self._known
        if is_known and identity not in self._unwritten:
            return True
        if not is_known and not (is_open or self._rate.allow(withdrawal.signer)):
            return False
        is_soon = withdrawal.message.deadline <= self._head + self._deadline_limit
        is_lasting = is_open or len(self._lasting) < self._limit // (2 if is_soon else 4)
        if not is_known and not self._take(identity, withdrawal, is_lasting=is_lasting):
            return False
        row = identity, withdrawal.signer, encode(withdrawal.message), not self._is_brief(identity)
        if self._write("INSERT OR REPLACE INTO withdrawals VALUES (?, ?, ?, ?)", [row]):
            self._unwritten.discard(identity)
            self._unsynced.add(identity)
        else:
            self._unwritten.add(identity)
        return True

    async def sync(self) -> None:
        """Wait until all that was added so far is on the disk, also after a power failure."""
        async with self._syncing:
            added = set(self._unsynced)
            try:
                if self._path is not None and added:
                    await asyncio.to_thread(_sync, self._path)
            except OSError as error:
                self._failed(error)
            else:
                self._unsynced -= added

    def of(self, order: str) -> list[Verified[Withdrawal]]:
        """The withdrawals of the orders with this hash (64 hexadecimal digits), one of each signer."""
        return list(self._by_order.get(order, {}).values())

    def is_kept(self, order: bytes) -> bool:
        """Whether the withdrawal of the order with this identity is known until its deadline, whatever fails."""
        is_on_disk = order not in self._unwritten and order not in self._unsynced
        return is_on_disk and order in self._known and not self._is_brief(order)

    def expire(self, head: int) -> None:
        """Forget the withdrawals whose deadline is not after block `head`: their orders have expired, too."""
        self._head = head
        for due in (self._lasting, self._brief):
            if count := bisect_right(due, head, key=lambda one: one[0]):
                self._forget(due[:count])
                del due[:count]

    def _take(self, identity: bytes, withdrawal: Verified[Withdrawal], *, is_lasting: bool) -> bool:
        due = withdrawal.message.deadline, identity
        if self._by_signer[withdrawal.signer] >= self._limit_per_signer:
            return False
        if len(self._known) >= self._limit:
            if not self._brief or not (is_lasting or due < self._brief[-1]):
                return False
            self._forget([self._brief.pop()])
        self._known[identity] = withdrawal
        self._by_order.setdefault(withdrawal.message.order, {})[identity] = withdrawal
        self._by_signer[withdrawal.signer] += 1
        insort(self._lasting if is_lasting else self._brief, due)
        return True

    def _is_brief(self, order: bytes) -> bool:
        due = self._known[order].message.deadline, order
        place = bisect_left(self._brief, due)
        return self._brief[place : place + 1] == [due]

    def _forget(self, due: list[tuple[int, bytes]]) -> None:
        for _, identity in due:
            forgotten = self._known.pop(identity)
            signer, order = forgotten.signer, forgotten.message.order
            del self._by_order[order][identity]
            if not self._by_order[order]:
                del self._by_order[order]
            self._unwritten.discard(identity)
            self._unsynced.discard(identity)
            self._by_signer[signer] -= 1
            if not self._by_signer[signer]:
                del self._by_signer[signer]
        self._write("DELETE FROM withdrawals WHERE identity = ?", [(identity,) for _, identity in due])

    def _load(self) -> None:
        if self._database is None:
            return
        try:
            rows = self._database.execute("SELECT identity, signer, payload, lasting FROM withdrawals").fetchall()
        except sqlite3.Error as error:
            self._failed(error)
            return
        for identity, signer, payload, lasting in rows:
            try:
                message = decode(payload)
            except InvalidMessage as error:
                self._failed(error)
                continue
            if isinstance(message, Withdrawal):
                verified = Verified(message, message_hash(message), signer)
                self._take(identity, verified, is_lasting=bool(lasting))
                self._unsynced.add(identity)

    def _write(self, statement: str, rows: list[tuple[object, ...]]) -> bool:
        if self._database is None:
            return self._path is None
        try:
            self._database.execute("BEGIN")
            self._database.executemany(statement, rows)
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
            self._failed(error)
            return False
        self._outage.recovered("withdrawals are kept on disk again")
        return True

    def _failed(self, error: Exception) -> None:
        assert self._path is not None
        self._outage.failed(WithdrawalsNotKept(self._path, error), "withdrawals are known until the process ends")


def _sync(path: Path) -> None:
    """Sync what was committed to the database at `path`. It is in SQLite's log, or was synced when it left that."""
    sync_file(path.with_name(f"{path.name}-wal"))
    sync_directory(path.parent)

"""The sent transactions of one account that are not settled: which nonces they use, and what they do; their counts.

On disk they are the rows of one table, by nonce, which all processes of the account share: a row reserves its nonce. It
names the process that waits for it, by the file that this process keeps locked while it lives; a row whose process has
ended, or that names none, was left behind. It has all versions of the transaction, each written before it is sent.
"""

from __future__ import annotations

import asyncio
import json
import os
import sqlite3
import tempfile
import time
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from mesh.base.database import SyncedDatabase, transactions_not_kept
from mesh.base.flood import BoundedDict
from mesh.base.private_files import is_locked, lock, try_lock
from mesh.chain._accounts import SignedTransaction
from mesh.errors import ConfigurationError
from mesh.telemetry.metrics import MetricFamily, by_label, counter
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from mesh.chain.answers import BlockHeader, MinedTransaction

Sent: TypeAlias = dict[str, Any]
"""A transaction in the table, as JSON."""
FILE: Final = "transactions.sqlite"
LOCK: Final = ".lock"
_SCHEMA: Final = """
    CREATE TABLE IF NOT EXISTS transactions (nonce INTEGER PRIMARY KEY, owner TEXT NOT NULL, sent TEXT NOT NULL);
"""


class TransactionStore:
    """The table of an account's sent transactions on one chain, in a folder, for one process; `close` it.

    Raises `ConfigurationError`: `transactions-not-kept` if the disk refuses, `transaction-damaged` for what it can't
    read. Not for network file systems, whose locks other machines may not see.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._database = SyncedDatabase(folder / FILE, _SCHEMA)
        self._descriptor: int | None = None
        self._removed: set[int] = set()
        """What is to be removed."""
        with self._on_disk():
            try:
                self._database.open()
                self._clear_locks()
                self._owner = self._lock()
            except BaseException:
                self._database.close()
                raise

    def close(self) -> None:
        """What this process has in the table is left behind."""
        self._database.close()
        if self._descriptor is not None:
            (self._folder / self._owner).with_suffix(LOCK).unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = None

    def add(self, nonce: int, sent: Sent) -> bool:
        """Reserve a nonce with its transaction; False if it is taken. `sync` it.

        What this process could not remove when its disk was full is replaced.
        """
        statement = (
            "INSERT INTO transactions VALUES (?, ?, ?) ON CONFLICT (nonce)"
            " DO UPDATE SET sent = excluded.sent WHERE owner = excluded.owner"
        )
        is_added = self._write(statement, (nonce, self._owner, json.dumps(sent)))
        self._removed.discard(nonce)
        return is_added

    def update(self, nonce: int, sent: Sent) -> None:
        """Write a transaction that this process waits for again, with another version. `sync` it."""
        statement = "UPDATE transactions SET sent = ? WHERE nonce = ? AND owner = ?"
        self._write(statement, (json.dumps(sent), nonce, self._owner))

    async def sync(self) -> None:
        """Wait until what was written is on the disk."""
        with self._on_disk():
            await self._database.sync()

    def take(self, nonce: int) -> bool:
        """Wait for a transaction that was left behind; False if it is settled, or another process waits for it."""
        with self._on_disk():
            owners = self._database.rows("SELECT owner FROM transactions WHERE nonce = ?", (nonce,))
        if not owners or self._is_alive(owners[0][0]):
            return False
        statement = "UPDATE transactions SET owner = ? WHERE nonce = ? AND owner = ?"
        return self._write(statement, (self._owner, nonce, owners[0][0]))

    def release(self, nonce: int) -> bool:
        """Leave a transaction behind; another process may wait for it. False if the disk refuses."""
        with suppress(ConfigurationError):
            self._write("UPDATE transactions SET owner = '' WHERE nonce = ? AND owner = ?", (nonce, self._owner))
            return True
        return False

    def remove(self, nonce: int) -> None:
        """Forget a transaction that this process waits for; if the disk refuses, together with the next one."""
        self._removed.add(nonce)
        with suppress(ConfigurationError):
            rows = [(one, self._owner) for one in self._removed]
            self._write("DELETE FROM transactions WHERE nonce = ? AND owner = ?", *rows)
            self._removed.clear()

    def read(self) -> tuple[dict[int, Sent], frozenset[int]]:
        """The transactions that were left behind, by nonce, and the nonces that others wait for."""
        left, elsewhere, alive = {}, set(), dict[str, bool]()
        with self._on_disk():
            statement = "SELECT nonce, owner, sent FROM transactions WHERE owner != ? ORDER BY nonce"
            for nonce, owner, sent in self._database.rows(statement, (self._owner,)):
                if owner not in alive:
                    alive[owner] = self._is_alive(owner)
                if alive[owner]:
                    elsewhere.add(nonce)
                else:
                    left[nonce] = decode_json(sent)
        return left, frozenset(elsewhere)

    def _write(self, statement: str, *rows: tuple[object, ...]) -> bool:
        """Run a statement with each of the rows; whether it changed any of the table's."""
        with self._on_disk():
            return self._database.write((statement, rows)) > 0

    def _lock(self) -> str:
        """Create and lock this process's file; its name without the suffix."""
        while True:
            descriptor, name = tempfile.mkstemp(suffix=LOCK, prefix="", dir=self._folder)
            lock(descriptor)
            if os.path.exists(name):  # nobody took it for that of a process that has ended
                self._descriptor = descriptor
                return Path(name).stem
            os.close(descriptor)

    def _is_alive(self, owner: str) -> bool:
        """Whether another process that a row names has not ended."""
        return bool(owner) and is_locked((self._folder / owner).with_suffix(LOCK), ours_is_shared=True)

    def _clear_locks(self) -> None:
        """Remove the files of processes that have ended."""
        for path in self._folder.glob(f"*{LOCK}"):
            with suppress(FileNotFoundError), path.open("rb") as file:
                if try_lock(file):
                    path.unlink()

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.OperationalError) as error:
            raise transactions_not_kept(self._folder, error) from None
        except (sqlite3.DatabaseError, ValueError):
            raise ConfigurationError(
                f"{self._folder / FILE} is no table of sent transactions",
                hint="it is damaged; move it away",
                code="transaction-damaged",
            ) from None


@dataclass(slots=True, kw_only=True, eq=False)
class PendingTransaction:
    """A nonce of the account, and the transaction that was sent with it, in one or several versions.

    The versions differ in their fees only; at most one of them is ever mined.
    """

    nonce: int
    fields: dict[str, Any]
    """Of the newest version, ready to be signed; `to` is empty if it deploys."""
    versions: list[SignedTransaction]
    sent_at: float = field(default_factory=time.time)
    """When the first version was sent (Unix time, seconds)."""
    is_watched: bool = True
    """Whether a task of this process waits for it."""
    is_reserved: bool = False
    """Whether the store says that this process waits for it."""

    @property
    def newest(self) -> SignedTransaction:
        """The version that was signed last."""
        return self.versions[-1]

    @property
    def as_json(self) -> Sent:
        """For the store."""
        raw = {version.hash: version.raw.hex() for version in self.versions}
        return {"sentAt": self.sent_at, "fields": self.fields, "versions": raw}

    @classmethod
    def of_json(cls, nonce: int, sent: Sent) -> PendingTransaction:
        """The transaction that is in the store, and which no process waits for."""
        return cls(
            nonce=nonce,
            fields=sent["fields"],
            versions=[SignedTransaction(bytes.fromhex(raw), tx) for tx, raw in sent["versions"].items()],
            sent_at=sent["sentAt"],
            is_watched=False,
        )


class _Count(NamedTuple):
    """How many transactions an account had sent as of a block."""

    block: int
    block_hash: bytes
    transactions: int


class PendingTransactions:
    """The pending transactions of one account at one node, shared by all its senders, which take turns by `lock`.

    With a `store` they are on disk as well: other processes of the account see them, and after a restart those that
    were left behind are among the `abandoned`.
    """

    def __init__(self, store: TransactionStore | None = None) -> None:
        self.lock = asyncio.Lock()
        self._store = store
        self._entries: dict[int, PendingTransaction] = {}
        self._elsewhere: frozenset[int] = frozenset()
        self._mined: BoundedDict[int, PendingTransaction] = BoundedDict(256)
        """The latest: a reorganisation may send them back to the pool."""
        self._counted: _Count | None = None
        self._unblock_at = 0.0
        self.missing: int | None = None
        """The nonce that the next transactions waited for, and that nothing was known to have, when that was looked at.
        """

    def counted(self, head: BlockHeader | None) -> int | None:
        """How many transactions the account has sent, if that was counted at block `head` or at its parent.

        None says to ask the node: blocks may have been replaced since.
        """
        if head is None or self._counted is None or self._counted.block_hash not in (head.hash, head.parent_hash):
            return None
        return self._counted.transactions

    def count(self, head: BlockHeader | None, transactions: int | None) -> None:
        """Note how many transactions the account has sent as of block `head`; None if that is not certain."""
        self._counted = None
        if head is not None and transactions is not None:
            self._counted = _Count(head.number, head.hash, transactions)

    async def refresh(self) -> None:
        """See what other processes did to the store."""
        if self._store is None:
            return
        left, self._elsewhere = self._store.read()
        ours = [entry for entry in self._entries.values() if entry.is_watched or entry.is_reserved]
        if left:
            await self._store.sync()  # before it is sent again: whoever left it may have been killed before its sync
        kept = {entry.nonce: entry for entry in ours if self._entries.get(entry.nonce) is entry}
        self._entries = {nonce: PendingTransaction.of_json(nonce, sent) for nonce, sent in left.items()} | kept

    @property
    def taken(self) -> Collection[int]:
        """The nonces of transactions that a task waits for, here or in another process."""
        return self._elsewhere | {nonce for nonce, entry in self._entries.items() if entry.is_watched}

    @property
    def abandoned(self) -> tuple[PendingTransaction, ...]:
        """Transactions that nothing waits for any more, by nonce: their sender lost the node, gave up or ended."""
        return tuple(entry for _, entry in sorted(self._entries.items()) if not entry.is_watched)

    def sent(self, nonce: int) -> PendingTransaction | None:
        """The transaction with that nonce: one that waits, or was mined and a reorganisation took out of its block."""
        return self._entries.get(nonce, self._mined.get(nonce))

    def may_unblock(self, pause: float) -> bool:
        """Whether a task may see to the nonces that others wait for: one does, once in `pause` seconds."""
        now = asyncio.get_running_loop().time()
        if now < self._unblock_at:
            return False
        self._unblock_at = now + pause
        return True

    async def add(self, entry: PendingTransaction) -> bool:
        """Take the entry's nonce, also from an abandoned one; False if another process was faster."""
        if self._store is not None:
            abandoned = self._entries.get(entry.nonce)
            if abandoned is not None:
                self.forget(abandoned)
            entry.is_reserved = self._store.add(entry.nonce, entry.as_json)
            if not entry.is_reserved:
                return False
            try:
                await self._store.sync()
            except BaseException:
                self.forget(entry)  # it was not sent
                raise
        self._entries[entry.nonce] = entry
        return True

    async def add_version(self, entry: PendingTransaction, fields: dict[str, Any], signed: SignedTransaction) -> None:
        """Record another version of a transaction, before it is sent."""
        entry.fields = fields
        entry.versions.append(signed)
        if self._store is not None and entry.is_reserved:
            self._store.update(entry.nonce, entry.as_json)
            await self._store.sync()

    async def take_over(self, entry: PendingTransaction) -> bool:
        """Wait for a transaction that nothing waits for from now on; False if another process was faster."""
        if self._mined.get(entry.nonce) is entry:
            entry.is_watched = True
            return await self.add(entry)
        if self._store is not None and not entry.is_reserved:
            entry.is_reserved = self._store.take(entry.nonce)
            if not entry.is_reserved:
                self._entries.pop(entry.nonce, None)
                return False
        entry.is_watched = True
        return True

    def abandon(self, entry: PendingTransaction) -> None:
        """Stop waiting for a transaction whose outcome is unknown. Nothing happens if it was forgotten already."""
        entry.is_watched = False
        if self._store is not None and entry.is_reserved:
            entry.is_reserved = not self._store.release(entry.nonce)

    def settle(self, entry: PendingTransaction, receipt: MinedTransaction) -> None:
        """Drop a transaction that is mined and confirmed."""
        self.forget(entry)
        self._mined[entry.nonce] = entry
        if self._counted is not None and self._counted.block <= receipt.block_number:
            self._counted = _Count(receipt.block_number, receipt.block_hash, self._counted.transactions)

    def forget(self, entry: PendingTransaction) -> None:
        """Drop a transaction that can't be mined any more, or that the node never accepted."""
        if self._entries.get(entry.nonce) is entry:
            del self._entries[entry.nonce]
        if self._store is not None and (entry.is_reserved or self._store.take(entry.nonce)):
            entry.is_reserved = False
            self._store.remove(entry.nonce)

    def close(self) -> None:
        """Other processes may wait for what is pending."""
        if self._store is not None:
            self._store.close()


class TransactionOutcome(StrEnum):
    """The outcome of a transaction. A transaction that is mined was also sent, and counts as both."""

    SENT = "sent"
    """Given to the node for the first time."""
    REPLACED = "replaced"
    """Replaced by one with higher fees because it was stuck."""
    MINED = "mined"
    """Mined, and successful."""
    FAILED = "failed"
    """Mined and paid for, but reverted."""
    REFUSED = "refused"
    """Never sent, because the contracts would revert it."""
    LOST = "lost"
    """Another transaction was mined with its nonce."""


class TransactionCounts:
    """The transactions that were sent through a node by their outcome, and what they have cost."""

    def __init__(self) -> None:
        self.by_outcome = Counter(dict.fromkeys(TransactionOutcome, 0))
        self.gas_used = 0
        self.wei = 0
        """What they have cost."""
        self.data_wei = 0
        """The part of it that an OP-type rollup has charged for their data."""

    def families(self) -> tuple[MetricFamily, ...]:
        """The counters in Prometheus terms."""
        outcomes = {outcome.value: float(count) for outcome, count in self.by_outcome.items()}
        meaning = "Transactions of this account, by what became of them"
        return (
            by_label("aira_transactions_total", "counter", meaning, "outcome", outcomes),
            counter("aira_gas_used_total", "Gas that transactions on the chain have used", self.gas_used),
            counter("aira_gas_spent_wei_total", "What these transactions have cost, wei", self.wei),
            counter("aira_data_spent_wei_total", "The part of it for their data, on OP-type rollups", self.data_wei),
        )

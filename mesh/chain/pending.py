"""The sent transactions of one account that are not settled: which nonces they use, and what they do."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, TypeVar

from mesh.chain.accounts import SignedTransaction
from mesh.flood import BoundedDict

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from mesh.chain.answers import BlockHeader, MinedTransaction
    from mesh.chain.transaction_store import LockedEntry, TransactionStore

T = TypeVar("T")

MINED_KEPT: Final = 256
"""Mined transactions of an account that are remembered: a reorganisation may send them back to the pool."""

Effect: TypeAlias = tuple[str, str, int]
"""What a transaction does: its recipient (empty: it deploys), its data (0x…) and its wei."""


@dataclass(slots=True, kw_only=True, eq=False)
class PendingTransaction:
    """A nonce of the account, and the transaction that was sent with it, in one or several versions.

    The versions differ in their fees only; at most one of them is ever mined.
    """

    nonce: int
    fields: dict[str, Any]
    """Of the newest version, ready to be signed."""

    versions: list[SignedTransaction]
    sent_at: float = field(default_factory=time.time)
    """When the first version was sent (Unix time, seconds)."""

    is_watched: bool = True
    """Whether a task of this process waits for it."""

    locked: LockedEntry | None = None
    """Its file in the store, while this process has it."""

    @property
    def newest(self) -> SignedTransaction:
        """The version that was signed last."""
        return self.versions[-1]

    @property
    def version(self) -> dict[str, Any]:
        """The newest version for the store."""
        fields = self.fields | {"to": self.fields["to"] or ""}
        return {"sentAt": self.sent_at, "hash": self.newest.hash, "raw": self.newest.raw.hex(), "fields": fields}

    @classmethod
    def stored(cls, nonce: int, versions: list[dict[str, Any]]) -> PendingTransaction:
        """The transaction whose versions are in the store, and which no process waits for."""
        return cls(
            nonce=nonce,
            fields=versions[-1]["fields"] | {"to": versions[-1]["fields"]["to"] or b""},
            versions=[SignedTransaction(raw=bytes.fromhex(one["raw"]), hash=one["hash"]) for one in versions],
            sent_at=versions[0]["sentAt"],
            is_watched=False,
        )

    @property
    def effect(self) -> Effect:
        """What it does."""
        return effect_of(self.fields)


def effect_of(fields: dict[str, Any]) -> Effect:
    """What a transaction with these fields does."""
    return fields["to"] or "", fields["data"], fields["value"]


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
        self._mined: BoundedDict[int, PendingTransaction] = BoundedDict(MINED_KEPT)
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
        mine = {nonce for nonce, entry in self._entries.items() if entry.is_watched}
        left, self._elsewhere = await _in_thread(partial(self._store.read, mine))
        watched = {nonce: self._entries[nonce] for nonce in mine if nonce in self._entries}
        self._entries = {nonce: PendingTransaction.stored(nonce, left[nonce]) for nonce in left} | watched

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
                await self.forget(abandoned)
            await self._lock_entry(entry, partial(self._store.add, entry.nonce, entry.version))
            if entry.locked is None:
                return False
        self._entries[entry.nonce] = entry
        return True

    async def add_version(self, entry: PendingTransaction, fields: dict[str, Any], signed: SignedTransaction) -> None:
        """Record another version of a transaction, before it is sent."""
        entry.fields = fields
        entry.versions.append(signed)
        if entry.locked is not None:
            await _in_thread(partial(entry.locked.append, entry.version))

    async def take_over(self, entry: PendingTransaction) -> bool:
        """Wait for a transaction that nothing waits for from now on; False if another process was faster."""
        if self._mined.get(entry.nonce) is entry:
            entry.is_watched = True
            return await self.add(entry)
        if self._store is not None and entry.locked is None:
            await self._lock_entry(entry, partial(self._store.lock, entry.nonce))
            if entry.locked is None:
                self._entries.pop(entry.nonce, None)
                return False
        entry.is_watched = True
        return True

    def abandon(self, entry: PendingTransaction) -> None:
        """Stop waiting for a transaction whose outcome is unknown. Nothing happens if it was forgotten already."""
        entry.is_watched = False
        if entry.locked is not None:
            entry.locked.release()
            entry.locked = None

    async def settle(self, entry: PendingTransaction, receipt: MinedTransaction) -> None:
        """Drop a transaction that is mined and confirmed."""
        await self.forget(entry)
        self._mined[entry.nonce] = entry
        if self._counted is not None and self._counted.block <= receipt.block_number:
            self._counted = _Count(receipt.block_number, receipt.block_hash, self._counted.transactions)

    async def forget(self, entry: PendingTransaction) -> None:
        """Drop a transaction that can't be mined any more, or that the node never accepted."""
        if self._entries.get(entry.nonce) is entry:
            del self._entries[entry.nonce]
        if self._store is not None and entry.locked is None:
            await self._lock_entry(entry, partial(self._store.lock, entry.nonce))
        if entry.locked is not None:
            locked, entry.locked = entry.locked, None
            await _in_thread(locked.remove)

    async def _lock_entry(self, entry: PendingTransaction, lock: Callable[[], LockedEntry | None]) -> None:
        def work() -> None:
            entry.locked = lock()

        try:
            await _in_thread(work)
        except asyncio.CancelledError:
            self.abandon(entry)
            raise


async def _in_thread(work: Callable[[], T]) -> T:
    """Do work that waits for the disk outside of the event loop. When cancelled, the work is finished first."""
    working = asyncio.get_running_loop().run_in_executor(None, work)
    try:
        return await asyncio.shield(working)
    except asyncio.CancelledError:
        await asyncio.wait([working])
        raise

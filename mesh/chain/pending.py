"""The sent transactions of one account that are not settled: which nonces they use, and what they do."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from mesh.chain.accounts import SignedTransaction
    from mesh.chain.transaction_store import LockedEntry, PendingTransaction, TransactionStore

T = TypeVar("T")

MINED_KEPT: Final = 256
"""Mined transactions of an account that are remembered: a reorganisation may send them back to the pool."""


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
        self._mined: OrderedDict[int, PendingTransaction] = OrderedDict()

    async def refresh(self) -> None:
        """See what other processes did to the store."""
        if self._store is None:
            return
        mine = {nonce for nonce, entry in self._entries.items() if entry.is_watched}
        store = self._store
        left, self._elsewhere = await _in_thread(lambda: store.read(mine))
        watched = {nonce: self._entries[nonce] for nonce in mine if nonce in self._entries}
        self._entries = {entry.nonce: entry for entry in left} | watched

    @property
    def taken(self) -> Collection[int]:
        """The nonces of transactions that a task waits for, here or in another process."""
        return self._elsewhere | {nonce for nonce, entry in self._entries.items() if entry.is_watched}

    @property
    def abandoned(self) -> tuple[PendingTransaction, ...]:
        """Transactions that nothing waits for any more, by nonce: their sender lost the node, gave up or ended."""
        return tuple(entry for _, entry in sorted(self._entries.items()) if not entry.is_watched)

    def blocking(self, nonce: int) -> PendingTransaction | None:
        """The transaction with that nonce that nothing waits for, though others wait for it: to be replaced.

        It is abandoned, or was mined and a reorganisation sent it back to the pool.
        """
        entry = self._entries.get(nonce, self._mined.get(nonce))
        return None if entry is None or entry.is_watched else entry

    async def add(self, entry: PendingTransaction) -> bool:
        """Take the entry's nonce, also from an abandoned one; False if another process was faster."""
        if self._store is not None:
            abandoned = self._entries.get(entry.nonce)
            if abandoned is not None:
                await self.forget(abandoned)
            await self._lock_entry(entry, self._store.add)
            if entry.locked is None:
                return False
        self._entries[entry.nonce] = entry
        return True

    async def add_version(self, entry: PendingTransaction, fields: dict[str, Any], signed: SignedTransaction) -> None:
        """Record another version of a transaction, before it is sent."""
        entry.fields = fields
        entry.versions.append(signed)
        if entry.locked is not None:
            locked = entry.locked
            await _in_thread(lambda: locked.append(entry))

    async def take_over(self, entry: PendingTransaction) -> bool:
        """Wait for a transaction of `abandoned` or `blocking` from now on; False if another process was faster."""
        if self._mined.get(entry.nonce) is entry:
            entry.is_watched = True
            return await self.add(entry)
        if self._store is not None and entry.locked is None:
            await self._lock_entry(entry, self._store.lock)
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

    async def settle(self, entry: PendingTransaction) -> None:
        """Drop a transaction that is mined and confirmed."""
        await self.forget(entry)
        self._mined[entry.nonce] = entry
        if len(self._mined) > MINED_KEPT:
            self._mined.popitem(last=False)

    async def forget(self, entry: PendingTransaction) -> None:
        """Drop a transaction that can't be mined any more, or that the node never accepted."""
        if self._entries.get(entry.nonce) is entry:
            del self._entries[entry.nonce]
        if self._store is not None and entry.locked is None:
            await self._lock_entry(entry, self._store.lock)
        if entry.locked is not None:
            locked, entry.locked = entry.locked, None
            await _in_thread(locked.remove)

    async def _lock_entry(
        self, entry: PendingTransaction, lock: Callable[[PendingTransaction], LockedEntry | None]
    ) -> None:
        def work() -> None:
            entry.locked = lock(entry)

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

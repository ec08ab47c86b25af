"""The transactions of one account that went out and are not settled: which numbers they hold, and what they do."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from mesh.chain.accounts import SignedTransaction
    from mesh.chain.transaction_store import LockedEntry, TransactionStore

T = TypeVar("T")

Effect: TypeAlias = tuple[str, str, int]
"""What a transaction does: to whom (empty: it deploys), with which data (0x…), with how many wei."""


@dataclass(slots=True, kw_only=True, eq=False)
class Pending:
    """A number of the account, and the transaction that was sent with it, in one or several versions.

    The versions differ in their fees only; at most one of them is ever mined.
    """

    nonce: int
    fields: dict[str, Any]
    """Of the newest version, ready to be signed."""

    versions: list[SignedTransaction]
    sent_at: float = field(default_factory=time.time)
    """When the first version went out (Unix time, seconds)."""

    is_watched: bool = True
    """Whether somebody in this process waits for it."""

    hold: LockedEntry | None = None
    """Its entry in the journal, while this process has it."""

    @property
    def effect(self) -> Effect:
        """What it does."""
        return effect_of(self.fields)


class PendingTransactions:
    """What one account sent through one node; all senders of the account share it, and take turns by its `lock`.

    With a `journal` the entries are on disk as well: other processes of the account see them, and a later life finds
    those that an earlier one left behind. Of those nobody watches, `abandoned` tells.
    """

    def __init__(self, journal: TransactionStore | None = None) -> None:
        self.lock = asyncio.Lock()
        self._journal = journal
        self._entries: dict[int, Pending] = {}
        self._elsewhere: frozenset[int] = frozenset()

    async def refresh(self) -> None:
        """See what other processes did to the journal."""
        if self._journal is None:
            return
        mine = {nonce for nonce, entry in self._entries.items() if entry.is_watched}
        journal = self._journal
        left, self._elsewhere = await _in_thread(lambda: journal.read(mine))
        watched = {nonce: self._entries[nonce] for nonce in mine if nonce in self._entries}
        self._entries = {entry.nonce: entry for entry in left} | watched

    @property
    def taken(self) -> Collection[int]:
        """Numbers of transactions that somebody watches, here or in another process."""
        return self._elsewhere | {nonce for nonce, entry in self._entries.items() if entry.is_watched}

    @property
    def abandoned(self) -> tuple[Pending, ...]:
        """What nobody watches: its sender lost the node, gave up waiting, was cancelled or ended; by number."""
        return tuple(entry for _, entry in sorted(self._entries.items()) if not entry.is_watched)

    async def add(self, entry: Pending) -> bool:
        """Take the entry's number, which an abandoned one gives up; False if another process was faster."""
        if self._journal is not None:
            abandoned = self._entries.get(entry.nonce)
            if abandoned is not None:
                await self.forget(abandoned)
            await self._hold(entry, self._journal.add)
            if entry.hold is None:
                return False
        self._entries[entry.nonce] = entry
        return True

    async def add_version(self, entry: Pending, fields: dict[str, Any], signed: SignedTransaction) -> None:
        """Keep another version of a transaction, before it is sent."""
        entry.fields = fields
        entry.versions.append(signed)
        if entry.hold is not None:
            hold = entry.hold
            await _in_thread(lambda: hold.append(entry))

    async def take_up(self, entry: Pending) -> bool:
        """Watch an abandoned transaction; False if another process was faster, or it is settled."""
        if self._journal is not None and entry.hold is None:
            await self._hold(entry, self._journal.hold)
            if entry.hold is None:
                self._entries.pop(entry.nonce, None)
                return False
        entry.is_watched = True
        return True

    def abandon(self, entry: Pending) -> None:
        """Watch a transaction no longer, its outcome unknown; nothing if it was forgotten already."""
        entry.is_watched = False
        if entry.hold is not None:
            entry.hold.release()
            entry.hold = None

    async def forget(self, entry: Pending) -> None:
        """Drop a transaction that is settled, or was never accepted."""
        if self._entries.get(entry.nonce) is entry:
            del self._entries[entry.nonce]
        if self._journal is not None and entry.hold is None:
            await self._hold(entry, self._journal.hold)
        if entry.hold is not None:
            hold, entry.hold = entry.hold, None
            await _in_thread(hold.remove)

    async def _hold(self, entry: Pending, how: Callable[[Pending], LockedEntry | None]) -> None:
        def work() -> None:
            entry.hold = how(entry)

        try:
            await _in_thread(work)
        except asyncio.CancelledError:
            self.abandon(entry)
            raise


async def _in_thread(work: Callable[[], T]) -> T:
    """Work that waits for the disk, away from the event loop. When cancelled, the work is done all the same first."""
    working = asyncio.get_running_loop().run_in_executor(None, work)
    try:
        return await asyncio.shield(working)
    except asyncio.CancelledError:
        await asyncio.wait([working])
        raise


def effect_of(fields: dict[str, Any]) -> Effect:
    """What a transaction with these fields does."""
    return fields["to"] or "", fields["data"], fields["value"]

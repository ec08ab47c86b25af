"""The messages under settlement.

A message is under settlement while it waits for others (jurors' results), while it is being sent to the chain, and
afterwards until the event of its liability is so deep in the followed chain that no reorganisation is expected to
revert it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from mesh.market.book import order_id
from schemas import Result

if TYPE_CHECKING:
    from schemas import Verified

USED_KEPT: Final = 8192
"""Used messages that are kept, at most: those of the blocks that a reorganisation may replace."""


@dataclass(slots=True)
class _Entry:
    message: Verified[Any]
    is_sending: bool = False
    """A transaction for the message waits, or waits for its event."""
    liability: str = ""
    block: int = 0
    """The block of the event that used the message; 0 while none was read."""
    number: int = field(default_factory=count().__next__)
    """In order of arrival."""


class Unconfirmed:
    """The messages under settlement; used ones are kept until their event is `depth` blocks deep, `limit` at most.

    `order_id` identifies a message.
    """

    def __init__(self, depth: int, *, limit: int = USED_KEPT) -> None:
        self._depth = depth
        self._limit = limit
        self._entries: dict[bytes, _Entry] = {}
        self._at: dict[str, set[bytes]] = {}
        """By liability: the messages that were used there, and the results for it."""
        self._used: deque[tuple[int, bytes]] = deque()
        """Block and message of each event that was read, the oldest first."""

    def __contains__(self, message: Verified[Any]) -> bool:
        return order_id(message) in self._entries

    def get(self, identity: bytes) -> Verified[Any] | None:
        """The message with this identity; None if it is not under settlement."""
        return entry.message if (entry := self._entries.get(identity)) else None

    def begin(self, *messages: Verified[Any]) -> None:
        """A transaction with these messages will be sent."""
        for message in messages:
            entry = self._entries.setdefault(order_id(message), _Entry(message))
            entry.is_sending = True
            if isinstance(message.message, Result):
                self._place(entry, message.message.liability)

    def hold(self, result: Verified[Result]) -> None:
        """The result waits for others that agree with it."""
        entry = self._entries.setdefault(order_id(result), _Entry(result))
        self._place(entry, result.message.liability)

    def held(self, liability: str) -> list[Verified[Result]]:
        """The results that wait at a liability, in order of arrival; none once one is being sent there, or was used."""
        entries = sorted(self._entries_at(liability, (Result,)), key=lambda entry: entry.number)
        if any(entry.is_sending or entry.block for entry in entries):
            return []
        return [entry.message for entry in entries]

    def release(self, result: Verified[Result]) -> bool:
        """Stop holding a result; False if it does not wait any more."""
        entry = self._entries.get(order_id(result))
        if entry is None or entry.is_sending or entry.block:
            return False
        self._remove(entry)
        return True

    def end(self, message: Verified[Any]) -> bool:
        """No transaction with the message waits any more. It is forgotten, and False returned, unless it was used."""
        entry = self._entries[order_id(message)]
        entry.is_sending = False
        if entry.block:
            self._used.append((entry.block, order_id(message)))
        else:
            self._remove(entry)
        return entry.block > 0

    def created(self, liability: str, block: int, *orders: Verified[Any]) -> None:
        """The event of a new liability was read, which these orders were used for."""
        for order in orders:
            entry = self._entries.setdefault(order_id(order), _Entry(order))
            self._place(entry, liability)
            self._mark(entry, block)

    def finalized(self, liability: str, block: int) -> None:
        """The event of a liability's end was read."""
        for entry in self._entries_at(liability, (Result,)):
            self._mark(entry, block)

    def reverted(self, liability: str, *kinds: type[Any]) -> list[Verified[Any]]:
        """An event of the liability was reverted: its messages of these kinds that must be settled again, and leave.

        Those with a transaction that waits stay: its sender notices.
        """
        again = []
        for entry in self._entries_at(liability, kinds):
            entry.block = 0
            if not entry.is_sending:
                self._remove(entry)
                again.append(entry.message)
        return again

    def is_read(self, message: Verified[Any], *, until: int) -> bool:
        """Whether an event that used the message was read, in block `until` or before."""
        return 0 < self._entries[order_id(message)].block <= until

    def confirm(self, head: int) -> None:
        """Forget the messages whose event is so deep below block `head` that it stays."""
        while self._used and (self._used[0][0] <= head - self._depth or len(self._used) > self._limit):
            block, identity = self._used.popleft()
            entry = self._entries.get(identity)
            if entry is not None and entry.block == block and not entry.is_sending:
                self._remove(entry)

    def _mark(self, entry: _Entry, block: int) -> None:
        entry.block = block
        if not entry.is_sending:
            self._used.append((block, order_id(entry.message)))

    def _place(self, entry: _Entry, liability: str) -> None:
        """Note where a message is used; an empty `liability` means nowhere."""
        identity = order_id(entry.message)
        if (placed := self._at.get(entry.liability)) is not None:
            placed.discard(identity)
            if not placed:
                del self._at[entry.liability]
        entry.liability = liability
        if liability:
            self._at.setdefault(liability, set()).add(identity)

    def _remove(self, entry: _Entry) -> None:
        self._place(entry, "")
        del self._entries[order_id(entry.message)]

    def _entries_at(self, liability: str, kinds: tuple[type[Any], ...]) -> list[_Entry]:
        entries = [self._entries[identity] for identity in self._at.get(liability, ())]
        return [entry for entry in entries if isinstance(entry.message.message, kinds)]

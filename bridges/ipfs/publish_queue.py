"""The queue of messages to one side, and the rank that decides which of several bridges sends them. Pure.

Each bridge announces a rank for as long as it can send. The bridge with the lowest rank is active; the others are on
standby and keep what they receive until they see it on the destination side. A bridge whose daemon has no peers ranks
behind one whose daemon has some; otherwise the longest-running bridge is first, so a new one takes over nothing.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bridges.ipfs.validation import RelayMessage
    from schemas import PresenceKey

TAKEOVER_AFTER: Final = 10.0
"""Seconds without any arrival after which messages left to other bridges are sent by this one."""
BRIDGE_ROLE: Final = "bridge"
"""The role under which a bridge announces its presence, whether or not it can send."""
_RANK_ROLE: Final = re.compile(r"bridge-turn-([01])-([0-9a-f]{16})")


class Rank(NamedTuple):
    """A bridge's place in the order; the lowest is active.

    `isolated`: its daemon has no peers on the topic. `since` is in nanoseconds of the system clock; `bridge` is the
    bridge's address.
    """

    isolated: bool
    since: int
    bridge: str

    @property
    def role(self) -> str:
        """The role of the presence token that announces it."""
        return f"bridge-turn-{int(self.isolated)}-{self.since:016x}"


def rank_of(key: PresenceKey) -> Rank | None:
    """The rank that a presence token announces; None if it announces something else."""
    found = _RANK_ROLE.fullmatch(key.role)
    return Rank(found[1] == "1", int(found[2], 16), key.agent) if found else None


def active_bridge(own: Rank | None, others: Iterable[Rank]) -> Rank | None:
    """The other bridge that sends instead of the one ranked `own`; None if that one is active itself."""
    best = min(others, default=None)
    return best if best is not None and (own is None or best < own) else None


@dataclass(slots=True)
class QueuedMessage:
    """A message waiting to be sent.

    `shared`: another bridge was present on arrival and holds it too. `left_to` is the bridge that should send it, None
    for this one. `since` is its arrival.
    """

    message: RelayMessage
    shared: bool
    left_to: Rank | None
    since: float


class PublishQueue:
    """Holds up to `limit` orders, and as many other messages. One beyond that is rejected, so that no accepted one is
    lost.

    Orders and other messages are sent in turn: a flood of orders does not delay results.
    """

    def __init__(self, *, limit: int) -> None:
        self._limit = limit
        self._orders: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._others: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._orders_next = False
        self._left: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._unheard: OrderedDict[bytes, QueuedMessage] = OrderedDict()
        self._last_arrival = 0.0

    def __len__(self) -> int:
        """The messages that this bridge should send."""
        return len(self._orders) + len(self._others)

    def __contains__(self, fingerprint: bytes) -> bool:
        return any(fingerprint in messages for messages in (self._orders, self._others, self._left))

    @property
    def left(self) -> int:
        """The messages left to other bridges and not seen at their destination yet."""
        return len(self._left)

    @property
    def unheard(self) -> int:
        """The messages sent while there were no listeners, to be sent again."""
        return len(self._unheard)

    def add(self, queued: QueuedMessage) -> bool:
        """Accept a message; False if the queue is full."""
        own = self._own(queued.message)
        if len(own) + len(self._left) >= self._limit:
            return False
        if queued.left_to is None:
            own[queued.message.fingerprint] = queued
        else:
            self._leave(queued, queued.left_to, queued.since)
        return True

    def next(self) -> QueuedMessage | None:
        """The oldest message that this bridge should send, of the kind whose turn it is; it stays in the queue."""
        first, second = (self._orders, self._others) if self._orders_next else (self._others, self._orders)
        return next(iter((first or second).values()), None)

    def arrived(self, fingerprint: bytes, *, now: float) -> bool:
        """The message is at its destination, whichever bridge sent it; False if it was not queued."""
        if self._left.pop(fingerprint, None) is not None:
            self._last_arrival = now
            return True
        return self._pop(fingerprint)

    def drop(self, fingerprint: bytes) -> None:
        """Remove a message that can't be sent, or must not be sent again."""
        self._pop(fingerprint)
        for messages in (self._left, self._unheard):
            messages.pop(fingerprint, None)

    def find(self, digest: str) -> list[RelayMessage]:
        """The messages with a hash (hexadecimal). O(messages)."""
        held = (self._orders, self._others, self._left, self._unheard)
        return [one.message for messages in held for one in messages.values() if one.message.hash == digest]

    def keep_unheard(self, queued: QueuedMessage) -> QueuedMessage | None:
        """Keep a message that was sent while there were no listeners; returns the oldest such one if it is dropped."""
        self._unheard[queued.message.fingerprint] = queued
        return None if len(self._unheard) <= self._limit else self._unheard.popitem(last=False)[1]

    def heard(self, fingerprint: bytes) -> bool:
        """Another node has published the message: it need not be sent again. False if it need not be anyway."""
        return self._unheard.pop(fingerprint, None) is not None

    def requeue_unheard(self) -> int:
        """There are listeners now: put the unheard messages before all others. Returns their number."""
        again, self._unheard = self._unheard, OrderedDict()
        for fingerprint in reversed(again):
            own = self._own(again[fingerprint].message)
            own[fingerprint] = again[fingerprint]
            own.move_to_end(fingerprint, last=False)
        return len(again)

    def hand_over(self, to: Rank, *, now: float) -> None:
        """Another bridge is active from now on: leave it the messages that it holds too."""
        for own in (self._others, self._orders):
            for fingerprint in [name for name, queued in own.items() if queued.shared]:
                self._leave(own.pop(fingerprint), to, now)

    def reassign(self, gone: Rank, successor: Rank | None, *, now: float) -> None:
        """The bridge ranked `gone` no longer sends: its messages go to `successor`, or to this bridge."""
        for fingerprint in [name for name, queued in self._left.items() if queued.left_to == gone]:
            queued = self._left.pop(fingerprint)
            if successor is None:
                self._take(queued)
            else:
                self._leave(queued, successor, now)

    def forget_left(self) -> list[bytes]:
        """Forget what was left to others, because this bridge could not see whether they sent it. Returns it."""
        forgotten = list(self._left)
        self._left.clear()
        return forgotten

    def take_overdue(self, *, now: float) -> int:
        """Take back messages left to others if none of those has arrived lately. Returns their number."""
        if now - self._last_arrival < TAKEOVER_AFTER:
            return 0
        overdue = [name for name, queued in self._left.items() if now - queued.since >= TAKEOVER_AFTER]
        for fingerprint in overdue:
            self._take(self._left.pop(fingerprint))
        return len(overdue)

    def _take(self, queued: QueuedMessage) -> None:
        queued.left_to = None
        self._own(queued.message)[queued.message.fingerprint] = queued

    def _own(self, message: RelayMessage) -> OrderedDict[bytes, QueuedMessage]:
        return self._orders if message.kind in ("demand", "offer") else self._others

    def _pop(self, fingerprint: bytes) -> bool:
        """Remove a message that this bridge should send; then it is the other kind's turn. False if there is none."""
        for own in (self._others, self._orders):
            if own.pop(fingerprint, None) is not None:
                self._orders_next = own is self._others
                return True
        return False

    def _leave(self, queued: QueuedMessage, to: Rank, now: float) -> None:
        if not self._left:
            self._last_arrival = now
        queued.left_to = to
        self._left[queued.message.fingerprint] = queued

"""Protection against floods: what strangers may use is bounded per sender and in total, and what is dropped is counted.

A sender is what a limit can distinguish: the signer of a message, the Zenoh session that sent it, the replier of a
query. Everything here remembers a bounded number of senders, since a flood may come from fresh ones.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter, OrderedDict, deque
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.base.clock import Clock

log = logging.getLogger(__name__)

T = TypeVar("T")
K = TypeVar("K")
V = TypeVar("V")

SENDERS: Final = 4096
"""Senders that a limit remembers."""
REPORT_INTERVAL: Final = 60.0
"""Seconds between two log lines about drops."""
HEAVIEST: Final = 3
"""Senders that a log line names for each reason."""
UNFUNDED_POLLS: Final = 15
"""Intervals between polls of the chain in which a maker that can't pay may become able to, by what is under way; only
after them a copy of its order is worth a look."""


class BoundedDict(OrderedDict[K, V]):
    """A dict with the `limit` keys that were set last."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit

    def __setitem__(self, key: K, value: V) -> None:
        super().__setitem__(key, value)
        self.move_to_end(key)
        if len(self) > self._limit:
            self.popitem(last=False)


def forget_oldest(remembered: dict[Any, Any], limit: int) -> None:
    """Remove the oldest keys of a dict that has more than `limit`, until half of the limit is left.

    A plain dict that is trimmed now and then is faster than a `BoundedDict`, and takes half of its memory. A key keeps
    its place when it is set again; pop it first to make it the youngest.
    """
    if len(remembered) > limit:
        for key in list(islice(remembered, len(remembered) - limit // 2)):
            remembered.pop(key, None)


class Rate(NamedTuple):
    """`per_second` on average, and up to `burst` at once."""

    per_second: float
    burst: float


class _Bucket:
    """A token bucket."""

    __slots__ = ("at", "left")

    def __init__(self, rate: Rate, now: float) -> None:
        self.left = rate.burst
        self.at = now

    def refill(self, rate: Rate, now: float) -> float:
        self.left = min(rate.burst, self.left + (now - self.at) * rate.per_second)
        self.at = now
        return self.left


class RateLimiter:
    """Token buckets: one for each sender and one for all. Not thread-safe.

    The least recently seen of more than `senders` senders is forgotten, and would start with a full bucket. So `total`,
    not `per_sender`, is what bounds a flood from fresh senders.
    """

    def __init__(
        self, *, per_sender: Rate, total: Rate | None = None, senders: int = SENDERS, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self._per_sender = per_sender
        self._total = total
        self._clock = clock
        self._buckets: BoundedDict[str, _Bucket] = BoundedDict(senders)
        self._all = None if total is None else _Bucket(total, clock.monotonic())

    def allow(self, sender: str, cost: float = 1.0) -> bool:
        """Take `cost` from the sender's bucket and from the total; False, and nothing taken, if either lacks it."""
        now = self._clock.monotonic()
        bucket = self._buckets[sender] = self._buckets.get(sender) or _Bucket(self._per_sender, now)
        if bucket.refill(self._per_sender, now) < cost:
            return False
        if self._all is not None and self._total is not None:
            if self._all.refill(self._total, now) < cost:
                return False
            self._all.left -= cost
        bucket.left -= cost
        return True


class FairQueue(Generic[T]):
    """A bounded queue that serves senders in turn: one item of each before the second of any.

    Items of a higher `priority` go first. At most `per_sender` items of one sender and `total` items wait. Use it in
    one event loop.
    """

    def __init__(self, *, per_sender: int, total: int) -> None:
        self._per_sender = per_sender
        self._total = total
        self._levels: dict[int, OrderedDict[str, deque[T]]] = {}
        self._heaviest: dict[int, str] = {}
        """Of each level the sender that had the most at its last put."""
        self._counts: Counter[str] = Counter()
        self._size = 0
        self._arrived = asyncio.Event()

    def __len__(self) -> int:
        return self._size

    @property
    def top(self) -> int | None:
        """The highest priority of the items that wait; None if none does."""
        return max(self._levels, default=None)

    def put(self, sender: str, item: T, *, priority: int = 0) -> list[T]:
        """Add an item; returns what was dropped for it: the item itself if the sender has too many, or, when the queue
        is full, one of the lowest priority: the newest of the sender that has the most."""
        if self._counts[sender] >= self._per_sender:
            return [item]
        level = self._levels.setdefault(priority, OrderedDict())
        items = level.setdefault(sender, deque())
        items.append(item)
        if len(items) >= len(level.get(self._heaviest.get(priority, ""), ())):
            self._heaviest[priority] = sender
        self._counts[sender] += 1
        self._size += 1
        self._arrived.set()
        return [self._drop_newest()] if self._size > self._total else []

    async def get_batch(self, limit: int) -> list[T]:
        """Wait for the next item; take it and those behind it that wait already, `limit` in all at most."""
        first = await self.get()
        return [first, *(self.get_nowait() for _ in range(min(limit - 1, self._size)))]

    async def get(self) -> T:
        """Wait for the next item and take it."""
        while not self._size:
            self._arrived.clear()
            await self._arrived.wait()
        return self.get_nowait()

    def get_nowait(self) -> T:
        """Take the next item. Raises `IndexError` when none waits."""
        if (priority := self.top) is None:
            raise IndexError("the queue is empty")
        sender, items = self._levels[priority].popitem(last=False)
        item = items.popleft()
        if items:
            self._levels[priority][sender] = items  # behind all others
        self._taken(sender, priority)
        return item

    def _drop_newest(self) -> T:
        priority = min(self._levels)
        level, sender = self._levels[priority], self._heaviest[priority]
        if len(level.get(sender, ())) < 2:
            sender = next(iter(level))  # nobody has more than one: the oldest
        item = level[sender].pop()
        if not level[sender]:
            del level[sender]
        self._taken(sender, priority)
        return item

    def _taken(self, sender: str, priority: int) -> None:
        if not self._levels[priority]:
            del self._levels[priority], self._heaviest[priority]
        self._size -= 1
        self._counts[sender] -= 1
        if not self._counts[sender]:
            del self._counts[sender]


class KnownSenders(BoundedDict[str, None]):
    """The latest `limit` senders that were added: those with whom something went well before."""

    def __init__(self, limit: int = SENDERS) -> None:
        super().__init__(limit)

    def add(self, sender: str) -> None:
        """Remember a sender."""
        self[sender] = None


class Drops:
    """Counts what was dropped, by reason and by sender. Thread-safe.

    Of each reason it remembers the `senders` heaviest senders, by estimate: a newcomer takes the place, and the count,
    of the lightest. `run` logs one line a minute while something is dropped.
    """

    def __init__(self, *, senders: int = 64, interval: float = REPORT_INTERVAL) -> None:
        self._senders = senders
        self._interval = interval
        self._lock = threading.Lock()
        self._totals: Counter[str] = Counter()
        self._by_sender: dict[str, Counter[str]] = {}
        self._reported: Counter[str] = Counter()

    def count(self, reason: str, sender: str = "", number: int = 1) -> None:
        """Count `number` drops for `reason` (a fixed word, `too-large`), of `sender` if it is known."""
        with self._lock:
            self._totals[reason] += number
            if not sender:
                return
            counts = self._by_sender.setdefault(reason, Counter())
            inherited = 0
            if sender not in counts and len(counts) >= self._senders:
                lightest = min(counts, key=counts.__getitem__)
                inherited = counts.pop(lightest)
            counts[sender] += inherited + number

    def totals(self) -> Mapping[str, int]:
        """How much was dropped, by reason."""
        with self._lock:
            return dict(self._totals)

    def heaviest(self, reason: str, number: int = HEAVIEST) -> list[tuple[str, int]]:
        """The senders with the most drops for `reason`, and their estimated counts since the last log line."""
        with self._lock:
            return self._by_sender.get(reason, Counter()).most_common(number)

    def senders(self) -> dict[str, dict[str, int]]:
        """The `heaviest` senders by reason."""
        return {reason: dict(self.heaviest(reason)) for reason in self.totals() if self.heaviest(reason)}

    def report(self) -> bool:
        """Log what was dropped since the last report, and begin to count senders again; False if nothing was."""
        with self._lock:
            new = self._totals - self._reported
            self._reported = self._totals.copy()
            senders = {reason: dict(self._by_sender[reason].most_common(HEAVIEST)) for reason in self._by_sender}
            self._by_sender.clear()
        if not new:
            return False
        parts = ", ".join(f"{number} {reason}" for reason, number in new.most_common())
        facts = log_event("flood", dropped=dict(new), senders=senders)
        log.warning("dropped in the last %d s: %s", self._interval, parts, extra=facts)
        return True

    async def run(self) -> None:
        """Report at each interval, until cancelled."""
        while True:
            await asyncio.sleep(self._interval)
            self.report()

"""The latest block of a node, looked for once for all who wait: pushed by the node, or polled when it is expected.

Where blocks come at a steady pace that is slower than the poll interval (a slot every 12 s), the next one is looked for
when it is due. The pace is that of the blocks' timestamps; when a block of some timestamp is there, by our clock, is
learned: a look that finds the block makes the next one a little earlier, a look that comes too soon makes it later.
Everywhere else, and until the pace is known, the node is asked each poll interval.
"""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.chain.answers import BlockHeader

SAMPLES: Final = 5
"""The latest times between two blocks that are compared."""
STEADY: Final = 4
"""How many of them must be equal, to within a second: slots may be missed."""
QUICKEST: Final = 2
"""Seconds between two blocks below which there is nothing to gain."""
EARLIER: Final = 0.005
LATER: Final = 0.05
"""Parts of the time between two blocks by which the next look comes earlier after a hit, or later after a miss."""
LONGEST_PAUSE: Final = 0.25
"""The same: between two looks for a block that is late."""
SILENCE: Final = 60.0
"""Seconds without a block after which a node that pushes blocks is asked all the same."""


class Pace:
    """When the next block is due, by the timestamps of those before it. Pure: times are passed."""

    def __init__(self, interval: float) -> None:
        self._interval = interval
        self._gaps: deque[int] = deque(maxlen=SAMPLES)
        self._offset: float | None = None
        """By our clock: how long after its timestamp a block is there."""
        self._misses = 0

    @property
    def seconds(self) -> int | None:
        """Seconds between two blocks; None where they come irregularly, or faster than is worth waiting for."""
        for gap in set(self._gaps):
            steady = sum(abs(gap - other) <= 1 for other in self._gaps)
            if gap > max(QUICKEST, self._interval) and steady >= min(STEADY, len(self._gaps)) >= STEADY - 1:
                return gap
        return None

    @property
    def is_learned(self) -> bool:
        """Whether it is known when the next block is due."""
        return self.seconds is not None and self._offset is not None

    @property
    def is_sampled(self) -> bool:
        """Whether enough blocks were seen to know."""
        return len(self._gaps) >= STEADY - 1 or any(gap <= max(QUICKEST, self._interval) for gap in self._gaps)

    def add(self, earlier: BlockHeader, later: BlockHeader) -> None:
        """Count the time between two blocks, of which the second follows the first."""
        if later.number == earlier.number + 1:
            self._gaps.append(later.timestamp - earlier.timestamp)

    def found(self, block: BlockHeader, now: float, *, waited: float) -> None:
        """A look found a new block, `waited` seconds after the look before."""
        seconds, delay = self.seconds, now - block.timestamp
        if seconds is None:
            self._offset = None
        elif self._offset is None:
            self._offset = delay if waited <= 2 * self._interval else None
        else:
            self._offset = min(self._offset, delay) - (0 if self._misses else EARLIER * seconds)
        self._misses = 0

    def missed(self) -> None:
        """A look at the time when a block was due found none."""
        self._misses = min(self._misses + 1, 10)
        if self._misses == 1 and self._offset is not None:
            self._offset += LATER * (self.seconds or 0)

    def is_early(self, latest: BlockHeader, now: float) -> bool:
        """Whether it is too early for the block after the latest."""
        return self.is_learned and not self._misses and self.pause(latest, now) > 0

    def pause(self, latest: BlockHeader | None, now: float) -> float:
        """Seconds until the next look."""
        seconds = self.seconds
        if latest is None or seconds is None or self._offset is None:
            return self._interval
        if self._misses:
            return min(LATER * (1 << self._misses - 1), LONGEST_PAUSE) * seconds
        return min(max(latest.timestamp + seconds + self._offset - now, 0.0), float(seconds))


class Heads:
    """The latest block: `look` asks for it now, and `next` waits for one that the caller has not seen.

    `ask` asks the node; `header` asks for the block of a number. Both raise the errors of the node, to one of those who
    wait; the others then ask themselves. `request_pushes` asks the node, when somebody waits, to call `pushed`; it is
    called often.
    """

    def __init__(
        self,
        ask: Callable[[], Awaitable[BlockHeader]],
        header: Callable[[int], Awaitable[BlockHeader | None]],
        *,
        interval: float,
        request_pushes: Callable[[], None] = lambda: None,
    ) -> None:
        self.latest: BlockHeader | None = None
        """The latest block that the node has returned or pushed, if any."""
        self.is_pushed = False
        """Whether the node pushes new blocks."""
        self.pace = Pace(interval)
        self._ask = ask
        self._header = header
        self._interval = interval
        self._request_pushes = request_pushes
        self._seen_at = 0.0
        self._expected = 0
        self._measured: BlockHeader | None = None
        self._looking = asyncio.Lock()
        self._news = asyncio.Event()

    @property
    def are_timely(self) -> bool:
        """Whether `next` returns soon after a block is there, so that nothing is gained by asking meanwhile."""
        return self.is_pushed or self.pace.is_learned

    async def look(self) -> BlockHeader:
        """The latest block, asked for now."""
        head = await self._ask()
        self._take(head)
        return head

    async def recent(self) -> BlockHeader:
        """The latest block, as it was a poll interval ago or later; the node is asked only if it is not known."""
        if self.latest is not None:
            now = self._now()
            if now - self._seen_at <= self._interval or self.is_pushed or self.pace.is_early(self.latest, now):
                return self.latest
        return await self.look()

    async def block_time(self, blocks: int) -> float | None:
        """Seconds between two of the last `blocks` blocks, measured at times; None if the chain does not tell."""
        last = await self.recent()
        if self._measured is None or not 0 <= last.number - self._measured.number <= 2 * blocks:
            self._measured = await self._header(max(1, last.number - blocks))
        first = self._measured
        if first is None or first.number >= last.number or first.timestamp >= last.timestamp:
            self._measured = None
            return None
        return (last.timestamp - first.timestamp) / (last.number - first.number)

    async def next(self, seen: bytes) -> BlockHeader:
        """The latest block as soon as its hash is not `seen`."""
        while self.latest is None or self.latest.hash == seen:
            async with self._looking:
                if self.latest is None:
                    await self.look()
                elif self.latest.hash == seen:
                    await self._wait_and_look(self.latest)
        return self.latest

    def expect(self, number: int) -> None:
        """The chain has a block of this number, as a receipt says: it is looked for at once if somebody waits."""
        if self.latest is not None and self.latest.number < number:
            self._expected = number
            self._announce()

    def pushed(self, head: BlockHeader | None) -> None:
        """The node has pushed a block; None means that it pushes no more."""
        self.is_pushed = head is not None
        if head is not None:
            self._take(head)

    def _take(self, head: BlockHeader) -> None:
        before, self.latest, self._seen_at = self.latest, head, self._now()
        if before is None or before.hash != head.hash:
            if before is not None and before.hash == head.parent_hash:
                self.pace.add(before, head)
            self._announce()

    def _announce(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    async def _wait_and_look(self, latest: BlockHeader) -> None:
        """Wait until the next block is due, or pushed; then look for it."""
        self._request_pushes()
        news, is_due, asked_at = self._news, self.pace.is_learned, self._seen_at
        pause = SILENCE if self.is_pushed else self.pace.pause(latest, self._now())
        if self._expected > latest.number:
            self._expected, pause = 0, 0.0
        with suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await news.wait()
                return
        if not self.pace.is_sampled:
            await self._sample(latest)
        if (head := await self.look()).hash != latest.hash:
            self.pace.found(head, self._now(), waited=self._now() - asked_at)
        elif is_due:
            self.pace.missed()

    async def _sample(self, later: BlockHeader) -> None:
        """Learn the pace from the blocks before the latest one."""
        while not self.pace.is_sampled and later.number > 0:
            earlier = await self._header(later.number - 1)
            if earlier is None or earlier.hash != later.parent_hash:
                return
            self.pace.add(earlier, later)
            later = earlier

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

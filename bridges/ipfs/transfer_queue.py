"""Files that wait to be transferred in one direction, each named by a message of some signer."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from bridges.ipfs.errors import IpfsError
from mesh.clock import SYSTEM_CLOCK
from mesh.content import ContentUnavailable
from mesh.errors import AiraError
from mesh.flood import FairQueue
from mesh.log_context import log_event
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.clock import Clock
    from mesh.flood import Drops
    from mesh.retry import RetryPolicy

log = logging.getLogger(__name__)

WORKERS: Final = 8
"""Files that are transferred in one direction at once."""
PER_SIGNER: Final = 32
"""Files that messages of one signer may have waiting."""
TOTAL: Final = 1024
"""Files that wait in one direction, and those that wait to be tried again."""
REMEMBERED_FOR: Final = 60.0
"""Seconds for which a file that was transferred, or that nobody has, is not tried again."""
REMEMBERED: Final = 16_384
"""Files of which that is remembered."""

AGAIN, USUAL, URGENT = 0, 1, 2
"""Priorities: what failed before, what orders name, what results name."""


class _Wanted(NamedTuple):
    cid: str
    signer: str
    backoff: Backoff


class TransferQueue:
    """Transfers files by `transfer(cid)`, `WORKERS` at once: `async with TransferQueue(...)`, then `add`.

    Signers take turns. A file that waits already, is being transferred, or was a moment ago, is not transferred once
    more. What fails is tried again by the policy `retry`, after everything that has not been tried yet. What never
    succeeds is not tried for `REMEMBERED_FOR` seconds. `transfer` should fail soon for a file that nobody has.
    `kind` names the direction in logs.
    """

    def __init__(
        self,
        transfer: Callable[[str], Awaitable[None]],
        *,
        kind: str,
        retry: RetryPolicy,
        drops: Drops,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._transfer = transfer
        self._kind = kind
        self._retry = retry
        self._drops = drops
        self._clock = clock
        self._queue: FairQueue[_Wanted] = FairQueue(per_sender=PER_SIGNER, total=TOTAL)
        self._waiting: set[tuple[str, str]] = set()
        self._running: set[str] = set()
        self._delayed: dict[str, asyncio.TimerHandle] = {}
        self._ended: OrderedDict[str, tuple[bool, float]] = OrderedDict()
        """Whether a file was transferred at last, and when."""
        self._counts: Counter[str] = Counter()

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(self._work(), name=f"{self._kind} {n}") for n in range(WORKERS)]
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        for timer in self._delayed.values():
            timer.cancel()
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)

    def add(self, cid: str, signer: str, *, priority: int = USUAL) -> None:
        """Transfer a file as soon as it is its turn."""
        if (signer, cid) in self._waiting or cid in self._running or cid in self._delayed:
            self._counts["joined"] += 1
            return
        if self._has_ended(cid, succeeded=True):
            self._counts["joined"] += 1
        elif self._has_ended(cid, succeeded=False):
            self._counts["failed"] += 1
            self._drops.count("content-unavailable", signer)
        else:
            self._put(_Wanted(cid, signer, Backoff(self._retry)), priority)

    @property
    def queued(self) -> int:
        """Files that wait for their turn, or to be tried again."""
        return len(self._queue) + len(self._delayed)

    @property
    def failed(self) -> int:
        """Files that were given up, and those for which there was no room."""
        return self._counts["failed"]

    @property
    def joined(self) -> int:
        """Files that were not transferred because another transfer of the same did."""
        return self._counts["joined"]

    def _put(self, wanted: _Wanted, priority: int) -> None:
        self._waiting.add((wanted.signer, wanted.cid))
        for dropped in self._queue.put(wanted.signer, wanted, priority=priority):
            self._waiting.discard((dropped.signer, dropped.cid))
            self._counts["failed"] += 1
            self._drops.count("content-queue-full", dropped.signer)

    async def _work(self) -> None:
        while True:
            wanted = await self._queue.get()
            self._waiting.discard((wanted.signer, wanted.cid))
            if wanted.cid in self._running or self._has_ended(wanted.cid, succeeded=True):
                self._counts["joined"] += 1
                continue
            self._running.add(wanted.cid)
            try:
                await self._transfer(wanted.cid)
            except AiraError as error:
                self._failed(wanted, error)
            else:
                self._remember(wanted.cid, succeeded=True)
            finally:
                self._running.discard(wanted.cid)

    def _failed(self, wanted: _Wanted, error: AiraError) -> None:
        may_retry = isinstance(error, ContentUnavailable | IpfsError) and len(self._delayed) < TOTAL
        delay = wanted.backoff.next_delay() if may_retry else None
        if delay is None:
            self._counts["failed"] += 1
            self._remember(wanted.cid, succeeded=False)
            failed = log_event("transfer-failed", kind=self._kind, cid=wanted.cid, code=error.code)
            log.info("%s of %s failed: %s", self._kind, wanted.cid, error, extra=failed)
            return
        retried = log_event("transfer-retried", kind=self._kind, cid=wanted.cid, code=error.code)
        log.debug("%s of %s is tried again: %s", self._kind, wanted.cid, error, extra=retried)
        timer = asyncio.get_running_loop().call_later(delay, self._try_again, wanted)
        self._delayed[wanted.cid] = timer

    def _try_again(self, wanted: _Wanted) -> None:
        self._delayed.pop(wanted.cid, None)
        self._put(wanted, AGAIN)

    def _has_ended(self, cid: str, *, succeeded: bool) -> bool:
        """Whether the last transfer of a file ended so, a moment ago."""
        result, at = self._ended.get(cid, (succeeded, -REMEMBERED_FOR))
        return result == succeeded and self._clock.monotonic() - at < REMEMBERED_FOR

    def _remember(self, cid: str, *, succeeded: bool) -> None:
        self._ended.pop(cid, None)
        self._ended[cid] = succeeded, self._clock.monotonic()
        if len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)

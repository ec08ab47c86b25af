"""Downloading one file over Zenoh: several blocks at once, from all who hold it, each checked by its hash."""

from __future__ import annotations

import threading
import time
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.content.errors import ContentCorrupt, ContentUnavailable
from mesh.errors import ClosedError, ContentError
from mesh.retry import Backoff, RetryPolicy
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future
    from pathlib import Path

    from mesh.content.assembly import Assembly
    from mesh.content.dag import BlockRef
    from mesh.content.files import Progress
    from mesh.content.requester import BlockRequester
    from mesh.content.store import Store

_RETRY: Final = RetryPolicy(initial=0.05, factor=1.5, ceiling=1.0)
"""Shorter delays than for a server: another holder may appear at any moment."""


@dataclass(frozen=True, kw_only=True)
class DownloadTiming:
    """How long a download waits for one block; seconds.

    It asks one known holder for up to `holder_timeout`, else all of them: for `query_timeout` at first, twice as long
    after each failure, and never less than `shortest_query`. A query to all must end early enough that holders which
    appeared meanwhile are asked too. Between two attempts it waits by the policy `retry`.
    """

    retry: RetryPolicy = _RETRY
    holder_timeout: float = 10.0
    query_timeout: float = 2.0
    shortest_query: float = 0.5


class Download:
    """One download of one file. `stop` may be called from any thread; blocks that arrived stay on the disk.

    It fails after `patience` seconds without a new block.
    """

    def __init__(
        self,
        store: Store,
        requester: BlockRequester,
        cid: str,
        *,
        patience: float,
        timing: DownloadTiming,
        size_limit: int | None = None,
        progress: Progress | None = None,
        sync: bool = True,
    ) -> None:
        self._store = store
        self._requester = requester
        self._cid = cid
        self._size_limit = size_limit
        self._patience = patience
        self._timing = timing
        self._progress = progress
        self._sync = sync
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._last_block = time.monotonic()
        self.blocks = 0
        self.bytes = 0

    def stop(self) -> None:
        """Make `run` end soon, with `ClosedError`."""
        self._stopped.set()
        self._requester.cancel()

    def run(self, pool: Executor, width: int) -> Path:
        """Download with at most `width` blocks under way in threads of `pool`. Returns where the file is in the store.

        Blocks until it is complete or fails. Raises what `Exchange.fetch` does, and `ClosedError` after `stop`.
        """
        with self._store.assemble(self._cid, size_limit=self._size_limit) as assembly:
            waiting = [assembly.root]
            running: set[Future[list[BlockRef]]] = set()
            try:
                while waiting or running:
                    while waiting and len(running) < width:
                        running.add(pool.submit(self._add_block, assembly, waiting.pop()))
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    for added in done:
                        # A stack: parts come in the order of the file, and few wait at a time.
                        waiting.extend(reversed(added.result()))
            except BaseException:
                self.stop()
                wait(running)
                raise
            return assembly.finish(sync=self._sync)

    def _add_block(self, assembly: Assembly, ref: BlockRef) -> list[BlockRef]:
        block = assembly.local(ref)
        if block is None:
            block = self._request(ref)
        refs = assembly.put_checked(ref, block)
        if self._progress is not None:
            with self._lock:  # so that it never goes backwards
                self._progress(*assembly.progress())
        return refs

    def _request(self, ref: BlockRef) -> bytes:
        """The block from the network, requested until nothing at all has arrived for `patience` seconds."""
        timing, requester = self._timing, self._requester
        backoff, query_timeout, hear_liars = Backoff(timing.retry), timing.query_timeout, False
        # Only an inner node covers this much. It is small, and asking all for it shows which of them have the file.
        from_all = ref.size is None or ref.size > MAX_BLOCK_SIZE
        while not self._stopped.is_set():
            timeout = max(self._last_block + self._patience - time.monotonic(), timing.shortest_query)
            if from_all:
                block = requester.request_from_all(ref.cid, timeout=min(timeout, query_timeout), hear_liars=hear_liars)
            else:
                block = requester.request(
                    ref.cid,
                    timeout=timeout,
                    query_timeout=query_timeout,
                    holder_timeout=timing.holder_timeout,
                    hear_liars=hear_liars,
                )
            if block is not None:
                self._count(block)
                return block
            pause = backoff.next_delay()
            if pause is None or time.monotonic() > self._last_block + self._patience:
                raise self._failure(ref.cid)
            self._stopped.wait(pause)
            query_timeout, hear_liars = query_timeout * 2, not hear_liars
        raise ClosedError(f"the download of {self._cid} was stopped", hint="fetch it again: it continues")

    def _count(self, block: bytes) -> None:
        with self._lock:
            self._last_block = time.monotonic()
            self.blocks += 1
            self.bytes += len(block)

    def _failure(self, cid: str) -> ContentError:
        what = "its root" if cid == self._cid else f"its block {cid}"
        senders = self._requester.corrupt_blocks
        if senders:
            return ContentCorrupt(self._cid, f"all replies for {what} were wrong", holders=senders)
        return ContentUnavailable(self._cid, f"no holder sent {what} within {self._patience:g} s")

"""Fetching one file: from its root down, several blocks at once, each checked before it is kept."""

from __future__ import annotations

import threading
import time
from concurrent.futures import FIRST_COMPLETED, wait
from typing import TYPE_CHECKING, Final

from mesh.content.errors import ContentCorrupt, ContentUnavailable
from mesh.errors import ClosedError, ContentError
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future
    from pathlib import Path

    from mesh.content.asking import Asker
    from mesh.content.assembly import Assembly
    from mesh.content.dag import BlockRef
    from mesh.content.holdings import Progress
    from mesh.content.store import Store

_FIRST_PAUSE: Final = 0.05
_LONGEST_PAUSE: Final = 1.0
_SHORTEST_QUERY: Final = 0.5
_FIRST_ROUND: Final = 2.0
"""Seconds: pauses between two attempts at a block that nobody gave, what the last attempt gets at least, and how long
everybody is waited for at the first one (twice as long at each further one): who does not answer must not keep us from
asking those who have come since."""


class Download:
    """One fetch of one file, in threads. `stop` may be called from anywhere; what came by then is kept on the disk."""

    def __init__(
        self,
        store: Store,
        asker: Asker,
        cid: str,
        *,
        patience: float,
        size_limit: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._store = store
        self._asker = asker
        self._cid = cid
        self._size_limit = size_limit
        self._patience = patience
        self._progress = progress
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._last = time.monotonic()
        self.blocks = 0
        self.bytes = 0

    def stop(self) -> None:
        """End `run` soon, with `ClosedError`."""
        self._stopped.set()
        self._asker.cancel()

    def run(self, pool: Executor, width: int) -> Path:
        """Fetch the file with at most `width` blocks on their way in threads of `pool`; where it is in the store.

        Blocks until it is there or fails. Raises what `Exchange.fetch` does, and `ClosedError` after `stop`.
        """
        with self._store.assemble(self._cid, size_limit=self._size_limit) as assembly:
            waiting = [assembly.root]
            running: set[Future[list[BlockRef]]] = set()
            try:
                while waiting or running:
                    while waiting and len(running) < width:
                        running.add(pool.submit(self._take, assembly, waiting.pop()))
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    for taken in done:
                        # The last found is taken first: parts come in the order of the file, and few wait at a time.
                        waiting.extend(reversed(taken.result()))
            except BaseException:
                self.stop()
                wait(running)
                raise
            return assembly.finish()

    def _take(self, assembly: Assembly, place: BlockRef) -> list[BlockRef]:
        block = assembly.local(place)
        if block is None:
            block = self._get(place)
        places = assembly.put_checked(place, block)
        if self._progress is not None:
            with self._lock:  # so that it never goes back
                self._progress(*assembly.progress())
        return places

    def _get(self, place: BlockRef) -> bytes:
        """The block from the network, asked for again and again until nothing came for as long as patience lasts."""
        cid, pause, round_seconds = place.cid, _FIRST_PAUSE, _FIRST_ROUND
        # Only a node of links leads to so much; it is short, and asking everybody for it tells who has the file.
        ask = self._asker.ask_all if place.size is None or place.size > MAX_BLOCK_SIZE else self._asker.ask
        while not self._stopped.is_set():
            left = self._last + self._patience - time.monotonic()
            block = ask(cid, seconds=max(left, _SHORTEST_QUERY), round_seconds=round_seconds)
            if block is not None:
                self._count(block)
                return block
            if time.monotonic() > self._last + self._patience:
                raise self._failure(cid)
            self._stopped.wait(pause)
            pause, round_seconds = min(pause * 1.5, _LONGEST_PAUSE), round_seconds * 2
        raise ClosedError(f"fetching {self._cid} was stopped", hint="fetch it again: it goes on from what came")

    def _count(self, block: bytes) -> None:
        with self._lock:
            self._last = time.monotonic()
            self.blocks += 1
            self.bytes += len(block)

    def _failure(self, cid: str) -> ContentError:
        what = "its root" if cid == self._cid else f"its block {cid}"
        lies = self._asker.lies
        if lies:
            return ContentCorrupt(self._cid, f"nobody gave the true bytes of {what}", holders=lies)
        return ContentUnavailable(self._cid, f"nobody gave {what} within {self._patience:g} s")

"""Downloading one file over Zenoh: several blocks at once, from all who hold it, each checked by its hash."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import zenoh

from mesh.content.dag import is_block
from mesh.content.errors import ContentCorrupt, ContentUnavailable
from mesh.errors import ClosedError, ContentError
from mesh.log_context import log_event
from mesh.retry import Backoff, RetryPolicy
from schemas.keys import CidKey
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from concurrent.futures import Executor, Future
    from pathlib import Path

    from mesh.content.assembly import Assembly
    from mesh.content.dag import BlockRef
    from mesh.content.files import Progress
    from mesh.content.store import Store

log = logging.getLogger(__name__)

HOLDER: Final = "holder"
"""Parameter of a query that only the session with that Zenoh id answers. Without it all holders do."""

_MAX_REPLIES: Final = 64
"""Replies to one query that are read; the rest of a flood is ignored."""
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


class BlockRequester:
    """Requests blocks for one file from the sessions that hold it, and checks each by its hash. For any thread.

    Holders that replied correctly are asked for the next blocks, each block from one of them: the one with the fewest
    requests under way, so that all are busy and fast ones send more. If one fails, all are asked.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._token = zenoh.CancellationToken()
        self._pending: dict[str, int] = {}
        """Requests under way to each trusted holder."""
        self._corrupt: Counter[str] = Counter()

    @property
    def corrupt_blocks(self) -> Mapping[str, int]:
        """How many replies of each holder (Zenoh id) did not have the hash asked for."""
        with self._lock:
            return dict(self._corrupt)

    def cancel(self) -> None:
        """End every query under way; later ones end at once."""
        self._token.cancel()  # type: ignore[no-untyped-call]

    def request(self, cid: str, *, timeout: float, query_timeout: float, holder_timeout: float) -> bytes | None:
        """The block from a known holder, within half of `timeout`, or else as `request_from_all`; None if none came."""
        holder = self._least_busy()
        if holder is None:
            return self.request_from_all(cid, timeout=min(timeout, query_timeout))
        try:
            block = self._request_from(holder, cid, min(timeout / 2, holder_timeout))
        finally:
            with self._lock:
                if holder in self._pending:
                    self._pending[holder] -= 1
        if block is not None:
            return block
        with self._lock:
            self._pending.pop(holder, None)
        return self.request_from_all(cid, timeout=min(timeout, query_timeout))

    def request_from_all(self, cid: str, *, timeout: float) -> bytes | None:
        """The block from the first holder that replies within `timeout`, or None.

        All that reply in that time are known holders from then on.
        """
        replies = _FirstBlock(self, cid)
        self._get(cid, "", timeout, zenoh.handlers.Callback(replies.on_reply, replies.on_end))
        replies.decided.wait()
        return replies.block

    def accept(self, cid: str, reply: zenoh.Reply) -> bytes | None:
        """The block of a reply, if it has the right hash: its sender becomes a known holder, else it is dropped."""
        if reply.ok is None:
            return None
        holder = str(reply.replier_id.zid) if reply.replier_id else "unknown"
        payload = reply.ok.payload
        block = payload.to_bytes() if len(payload) <= MAX_BLOCK_SIZE else b""
        correct = is_block(cid, block)
        with self._lock:
            if correct:
                if holder not in self._corrupt:
                    self._pending.setdefault(holder, 0)
                return block
            self._corrupt[holder] += 1
            self._pending.pop(holder, None)
        event = log_event("content-block-corrupt", holder=holder, cid=cid, bytes=len(payload))
        log.warning("%s sent %d bytes for %s that have another hash", holder, len(payload), cid, extra=event)
        return None

    def _least_busy(self) -> str | None:
        with self._lock:
            if not self._pending:
                return None
            holder = min(self._pending, key=self._pending.__getitem__)
            self._pending[holder] += 1
            return holder

    def _request_from(self, holder: str, cid: str, timeout: float) -> bytes | None:
        replies = self._get(cid, f"?{HOLDER}={holder}", timeout, zenoh.handlers.FifoChannel(_MAX_REPLIES))
        for reply in islice(replies, _MAX_REPLIES):
            block = self.accept(cid, reply)
            if block is not None:
                return block
        return None

    def _get(self, cid: str, parameters: str, timeout: float, handler: Any) -> Any:
        try:
            # Content has a lower priority than the market's messages; BLOCK holds up this thread and nothing else.
            return self._session.get(
                f"{CidKey(cid)}{parameters}",
                handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cancellation_token=self._token,
            )
        except zenoh.ZError as error:
            raise ClosedError(f"the network session can't request {cid}: {error}") from error


class _FirstBlock:
    """The first correct reply to a query to all. Later ones only make their senders known."""

    def __init__(self, requester: BlockRequester, cid: str) -> None:
        self._requester = requester
        self._cid = cid
        self._count = 0
        self.block: bytes | None = None
        self.decided = threading.Event()

    def on_reply(self, reply: zenoh.Reply) -> None:
        """Check a reply, in a thread of Zenoh's."""
        self._count += 1
        if self._count > _MAX_REPLIES:
            return
        block = self._requester.accept(self._cid, reply)
        if block is not None and self.block is None:
            self.block = block
            self.decided.set()

    def on_end(self) -> None:
        """No further reply will come."""
        self.decided.set()


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
    ) -> None:
        self._store = store
        self._requester = requester
        self._cid = cid
        self._size_limit = size_limit
        self._patience = patience
        self._timing = timing
        self._progress = progress
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
            return assembly.finish()

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
        backoff, query_timeout = Backoff(timing.retry), timing.query_timeout
        # Only an inner node covers this much. It is small, and asking all for it shows which of them have the file.
        from_all = ref.size is None or ref.size > MAX_BLOCK_SIZE
        while not self._stopped.is_set():
            timeout = max(self._last_block + self._patience - time.monotonic(), timing.shortest_query)
            if from_all:
                block = requester.request_from_all(ref.cid, timeout=min(timeout, query_timeout))
            else:
                block = requester.request(
                    ref.cid, timeout=timeout, query_timeout=query_timeout, holder_timeout=timing.holder_timeout
                )
            if block is not None:
                self._count(block)
                return block
            pause = backoff.next_delay()
            if pause is None or time.monotonic() > self._last_block + self._patience:
                raise self._failure(ref.cid)
            self._stopped.wait(pause)
            query_timeout *= 2
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

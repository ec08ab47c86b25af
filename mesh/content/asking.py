"""Asking the network for a block, and remembering who gave it and who lied."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING, Final

import zenoh

from mesh.content.assembly import is_block
from mesh.content.serving import HOLDER
from mesh.errors import ClosedError
from schemas.keys import CidKey
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Mapping

log = logging.getLogger(__name__)

_REPLIES: Final = 64
"""Answers to one query that are looked at; who floods an asker gets no further."""


class Asker:
    """Gets blocks for one file from whoever has them, checking each by its hash. Threads may share one.

    A holder that answered truly is asked first, and alone, for the next block, so that not every holder sends every
    block; when it fails, everybody is asked again. `cancel` ends all that is under way.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._token = zenoh.CancellationToken()
        self._holders: dict[str, None] = {}
        self._turn = 0
        self._lies: Counter[str] = Counter()

    @property
    def lies(self) -> Mapping[str, int]:
        """How many answers of each holder (Zenoh id) did not hash to the name asked for."""
        with self._lock:
            return dict(self._lies)

    def cancel(self) -> None:
        """End every query under way, and all later ones at once."""
        self._token.cancel()  # type: ignore[no-untyped-call]

    def ask(self, cid: str, *, seconds: float) -> bytes | None:
        """The block, from a known holder within half of `seconds` or else from anybody within `seconds`, or None."""
        holder = self._next_holder()
        if holder is not None:
            block = self._query(cid, f"?{HOLDER}={holder}", seconds / 2)
            if block is not None:
                return block
            with self._lock:
                self._holders.pop(holder, None)
        return self._query(cid, "", seconds)

    def _next_holder(self) -> str | None:
        with self._lock:
            if not self._holders:
                return None
            self._turn += 1
            return list(self._holders)[self._turn % len(self._holders)]

    def _query(self, cid: str, parameters: str, seconds: float) -> bytes | None:
        try:
            # Content goes below the market's messages in priority; BLOCK holds back this thread and nothing else.
            replies = self._session.get(
                f"{CidKey(cid)}{parameters}",
                zenoh.handlers.FifoChannel(_REPLIES),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=seconds,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cancellation_token=self._token,
            )
        except zenoh.ZError as error:
            raise ClosedError(f"the network session can't ask for {cid}: {error}") from error
        for reply in islice(replies, _REPLIES):
            block = self._believed(cid, reply)
            if block is not None:
                return block
        return None

    def _believed(self, cid: str, reply: zenoh.Reply) -> bytes | None:
        if reply.ok is None:
            return None
        holder = str(reply.replier_id.zid) if reply.replier_id else "unknown"
        payload = reply.ok.payload
        block = payload.to_bytes() if len(payload) <= MAX_BLOCK_SIZE else b""
        with self._lock:
            if is_block(cid, block):
                if holder not in self._lies:
                    self._holders[holder] = None
                return block
            self._lies[holder] += 1
            self._holders.pop(holder, None)
        log.warning("%s answered for %s with %d bytes that are not it", holder, cid, len(payload))
        return None

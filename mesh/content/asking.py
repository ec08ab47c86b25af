"""Asking the network for a block, and remembering who gave it and who lied."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

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
_HOLDER_SECONDS: Final = 10.0
"""How long one holder may take over one block before everybody is asked for it."""


class Asker:
    """Gets blocks for one file from whoever has them, checking each by its hash. Threads may share one.

    Holders that answered truly are asked for the next blocks, each block from one of them: the one with the fewest on
    their way, so that all are busy and the fast ones give more. When one fails, everybody is asked. `cancel` ends all
    that is under way.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._token = zenoh.CancellationToken()
        self._asked: dict[str, int] = {}
        """Blocks on their way from each holder that is believed."""
        self._lies: Counter[str] = Counter()

    @property
    def lies(self) -> Mapping[str, int]:
        """How many answers of each holder (Zenoh id) did not hash to the name asked for."""
        with self._lock:
            return dict(self._lies)

    def cancel(self) -> None:
        """End every query under way, and all later ones at once."""
        self._token.cancel()  # type: ignore[no-untyped-call]

    def ask(self, cid: str, *, seconds: float, round_seconds: float) -> bytes | None:
        """The block, from a known holder within half of `seconds` or else as `ask_all` gets it, or None."""
        holder = self._least_asked()
        if holder is None:
            return self.ask_all(cid, seconds=seconds, round_seconds=round_seconds)
        try:
            block = self._ask_one(holder, cid, min(seconds / 2, _HOLDER_SECONDS))
        finally:
            with self._lock:
                if holder in self._asked:
                    self._asked[holder] -= 1
        if block is not None:
            return block
        with self._lock:
            self._asked.pop(holder, None)
        return self.ask_all(cid, seconds=seconds, round_seconds=round_seconds)

    def ask_all(self, cid: str, *, seconds: float, round_seconds: float) -> bytes | None:
        """The block from whoever gives it first, within the shorter of both times, or None.

        All who give it in that time are holders from then on.
        """
        answers = _Answers(self, cid)
        self._get(cid, "", min(seconds, round_seconds), zenoh.handlers.Callback(answers.take, answers.end))
        answers.decided.wait()
        return answers.block

    def believed(self, cid: str, reply: zenoh.Reply) -> bytes | None:
        """The block of a reply, if it is the one asked for. Who gives it is a holder; who gives another is a liar."""
        if reply.ok is None:
            return None
        holder = str(reply.replier_id.zid) if reply.replier_id else "unknown"
        payload = reply.ok.payload
        block = payload.to_bytes() if len(payload) <= MAX_BLOCK_SIZE else b""
        true = is_block(cid, block)
        with self._lock:
            if true:
                if holder not in self._lies:
                    self._asked.setdefault(holder, 0)
                return block
            self._lies[holder] += 1
            self._asked.pop(holder, None)
        log.warning("%s answered for %s with %d bytes that are not it", holder, cid, len(payload))
        return None

    def _least_asked(self) -> str | None:
        with self._lock:
            if not self._asked:
                return None
            holder = min(self._asked, key=self._asked.__getitem__)
            self._asked[holder] += 1
            return holder

    def _ask_one(self, holder: str, cid: str, seconds: float) -> bytes | None:
        replies = self._get(cid, f"?{HOLDER}={holder}", seconds, zenoh.handlers.FifoChannel(_REPLIES))
        for reply in islice(replies, _REPLIES):
            block = self.believed(cid, reply)
            if block is not None:
                return block
        return None

    def _get(self, cid: str, parameters: str, seconds: float, handler: Any) -> Any:
        try:
            # Content goes below the market's messages in priority; BLOCK holds back this thread and nothing else.
            return self._session.get(
                f"{CidKey(cid)}{parameters}",
                handler,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=seconds,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cancellation_token=self._token,
            )
        except zenoh.ZError as error:
            raise ClosedError(f"the network session can't ask for {cid}: {error}") from error


class _Answers:
    """What comes back from asking everybody. Those who answer after the first are taken note of, too."""

    def __init__(self, asker: Asker, cid: str) -> None:
        self._asker = asker
        self._cid = cid
        self._count = 0
        self.block: bytes | None = None
        self.decided = threading.Event()

    def take(self, reply: zenoh.Reply) -> None:
        """One answer, from a thread of Zenoh's."""
        self._count += 1
        if self._count > _REPLIES:
            return
        block = self._asker.believed(self._cid, reply)
        if block is not None and self.block is None:
            self.block = block
            self.decided.set()

    def end(self) -> None:
        """No answer will come any more."""
        self.decided.set()

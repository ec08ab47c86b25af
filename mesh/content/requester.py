"""Requesting blocks over Zenoh from the sessions that hold them, among others that lie.

A block proves itself by its hash, so a lie costs only time: that of receiving it, of hashing it, and of a request that
it answers. So the replies of a session that lied lately are not hashed, and no reply ends a query but the right one.
A holder whose reply was right is asked for the next blocks on its own key, where on a site nobody else may answer.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from mesh.clock import SYSTEM_CLOCK
from mesh.content.dag import is_block
from mesh.errors import ClosedError, InvalidKey
from mesh.log_context import log_event
from schemas.agent_keys import CidKey
from schemas.keys import parse_key
from schemas.selectors import cid_selector
from schemas.unixfs import MAX_BLOCK_SIZE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.clock import Clock
    from mesh.flood import Drops

log = logging.getLogger(__name__)

IGNORED_FOR: Final = 60.0
"""Seconds for which the replies of a session that lied are ignored."""
LIARS: Final = 1024
"""Sessions that are remembered for their lies."""
LIE: Final = "content-lie"
"""The reason under which lies, and replies that were ignored after one, are counted as drops."""


class Replier(NamedTuple):
    """Who sent a reply: the agent in its key, empty if it names none, and the Zenoh id of its session.

    On a site the routers let only that agent reply on the key. Elsewhere it is a claim. A session's id is a claim
    everywhere, but one that only a changed Zenoh can make for another session.
    """

    agent: str
    session: str

    def __str__(self) -> str:
        return f"{self.agent}@{self.session}"


class Liars:
    """The sessions that sent wrong blocks in the last `IGNORED_FOR` seconds; at most `LIARS`. Thread-safe."""

    def __init__(self, drops: Drops, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self.drops: Final = drops
        self._clock = clock
        self._lock = threading.Lock()
        self._until: OrderedDict[str, float] = OrderedDict()

    def add(self, replier: Replier) -> bool:
        """Remember a lie; whether it is the first one of its session in that time."""
        self.drops.count(LIE, str(replier))
        with self._lock:
            is_known = self._until.pop(replier.session, 0.0) > self._clock.monotonic()
            self._until[replier.session] = self._clock.monotonic() + IGNORED_FOR
            if len(self._until) > LIARS:
                self._until.popitem(last=False)
        return not is_known

    def __contains__(self, replier: Replier) -> bool:
        with self._lock:
            return self._until.get(replier.session, 0.0) > self._clock.monotonic()


class BlockRequester:
    """Requests blocks for one file from the sessions that hold it, and checks each by its hash. For any thread.

    Holders that replied correctly are asked for the next blocks, each block from one of them: the one with the fewest
    requests under way, so that all are busy and fast ones send more. If one fails, all are asked.

    `hear_liars` is for the attempt after one that failed: it also hashes replies of sessions that lied, because a liar
    may have replied in the name of an honest session.
    """

    def __init__(self, session: zenoh.Session, liars: Liars) -> None:
        self._session = session
        self._liars = liars
        self._lock = threading.Lock()
        self._token = zenoh.CancellationToken()
        self._pending: dict[str, int] = {}
        """Requests under way to each known holder (address)."""
        self._corrupt: Counter[str] = Counter()

    @property
    def corrupt_blocks(self) -> Mapping[str, int]:
        """How many replies of each replier did not have the hash asked for."""
        with self._lock:
            return dict(self._corrupt)

    def cancel(self) -> None:
        """End every query under way; later ones end at once."""
        self._token.cancel()  # type: ignore[no-untyped-call]

    def request(
        self, cid: str, *, timeout: float, query_timeout: float, holder_timeout: float, hear_liars: bool
    ) -> bytes | None:
        """The block from a known holder, within half of `timeout`, or else as `request_from_all`; None if none came."""
        holder = self._least_busy()
        if holder is None:
            return self.request_from_all(cid, timeout=min(timeout, query_timeout), hear_liars=hear_liars)
        try:
            within = min(timeout / 2, holder_timeout)
            block = self._query(str(CidKey(holder, cid)), cid, within, hear_liars=hear_liars)
        finally:
            with self._lock:
                if holder in self._pending:
                    self._pending[holder] -= 1
        if block is not None:
            return block
        with self._lock:
            self._pending.pop(holder, None)
        return self.request_from_all(cid, timeout=min(timeout, query_timeout), hear_liars=hear_liars)

    def request_from_all(self, cid: str, *, timeout: float, hear_liars: bool) -> bytes | None:
        """The block from the first holder that replies within `timeout`, or None.

        All that reply correctly in that time are known holders from then on.
        """
        return self._query(cid_selector(cid=cid), cid, timeout, hear_liars=hear_liars)

    def check(self, cid: str, reply: zenoh.Reply, *, found: bytes | None, hear_liars: bool) -> bytes | None:
        """The block of a reply, if it is right: its sender becomes a known holder. `found` is the block, if known."""
        if reply.ok is None:
            return None
        replier = _replier_of(reply)
        is_liar = replier in self._liars
        if is_liar and not hear_liars:
            self._liars.drops.count(LIE, str(replier))
            return None
        payload = reply.ok.payload
        block = payload.to_bytes() if len(payload) <= MAX_BLOCK_SIZE else b""
        if block == found or is_block(cid, block):
            if replier.agent and not is_liar:
                with self._lock:
                    self._pending.setdefault(replier.agent, 0)
            return block
        with self._lock:
            self._corrupt[str(replier)] += 1
        if self._liars.add(replier):
            event = log_event(
                "content-block-corrupt", holder=replier.agent, session=replier.session, cid=cid, bytes=len(payload)
            )
            log.warning("%s sent %d bytes for %s that have another hash", replier, len(payload), cid, extra=event)
        return None

    def _least_busy(self) -> str | None:
        with self._lock:
            if not self._pending:
                return None
            holder = min(self._pending, key=self._pending.__getitem__)
            self._pending[holder] += 1
            return holder

    def _query(self, selector: str, cid: str, timeout: float, *, hear_liars: bool) -> bytes | None:
        replies = _FirstBlock(self, cid, hear_liars=hear_liars)
        try:
            # Content has a lower priority than the market's messages; BLOCK holds up this thread and nothing else.
            self._session.get(
                selector,
                zenoh.handlers.Callback(replies.on_reply, replies.decided.set),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
                cancellation_token=self._token,
            )
        except zenoh.ZError as error:
            raise ClosedError(f"the network session can't request {cid}: {error}") from error
        replies.decided.wait()
        return replies.block


class _FirstBlock:
    """The first correct reply to a query. Later ones only make their senders known."""

    def __init__(self, requester: BlockRequester, cid: str, *, hear_liars: bool) -> None:
        self._requester = requester
        self._cid = cid
        self._hear_liars = hear_liars
        self.block: bytes | None = None
        self.decided: Final = threading.Event()
        """Set once there is a block, or no further reply will come."""

    def on_reply(self, reply: zenoh.Reply) -> None:
        """Check a reply, in a thread of Zenoh's."""
        block = self._requester.check(self._cid, reply, found=self.block, hear_liars=self._hear_liars)
        if block is not None and self.block is None:
            self.block = block
            self.decided.set()


def _replier_of(reply: zenoh.Reply) -> Replier:
    session = str(reply.replier_id.zid) if reply.replier_id else "unknown"
    assert reply.ok is not None
    try:
        key = parse_key(str(reply.ok.key_expr))
    except InvalidKey:
        return Replier("", session)
    return Replier(key.agent if isinstance(key, CidKey) else "", session)

"""The relay between the two channels: each message is sent by one bridge, and again only if its sender repeats it.

A message that is seen on one side and not known on the other waits in the publish queue to the other. This bridge sends
it or, when another bridge is active, leaves it to that one until it is seen to have arrived. IPFS nodes drop messages
without a report; so what its sender repeats is relayed again after a while, by `REPETITION`.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum
from typing import TYPE_CHECKING, Final

from bridges.ipfs.journal import RelayedMessages, SeenMessages, Side
from bridges.ipfs.publish_queue import PublishQueue, QueuedMessage, Rank, active_bridge
from schemas.status import DirectionStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ipfs.journal import RelayJournal
    from bridges.ipfs.validation import RelayMessage

QUEUE_LIMIT: Final = 10_000
"""Messages that wait in one direction, at most; about 15 MB."""


class RelayOutcome(Enum):
    """What became of a received message."""

    ACCEPTED = "accepted"
    """It waits to be sent to the other side, by this bridge or another."""
    KNOWN = "known"
    """It is on the other side already, or waits to get there."""
    QUEUE_FULL = "queue full"
    """It was not accepted."""


class MessageRelay:
    """Both directions of one bridge.

    `clock` returns seconds; `limit` bounds the queue of each direction; `journal` is kept up to date.
    """

    def __init__(self, clock: Callable[[], float], journal: RelayJournal, *, limit: int = QUEUE_LIMIT) -> None:
        self._clock = clock
        self._journal = journal
        self._seen = SeenMessages(clock)
        self._relayed = {side: RelayedMessages(clock) for side in Side}
        self.queues: Final = {side: PublishQueue(limit=limit) for side in Side}
        """The queue towards each side."""
        self.counts: Final = {side: Counter[str]() for side in Side}
        """Counts of the direction towards each side."""
        self.invalid: Final = {side: Counter[str]() for side in Side}
        self.dropped: Final = {side: Counter[str]() for side in Side}
        self.kinds: Final = {side: Counter[str]() for side in Side}
        self.own: Rank | None = None
        """This bridge's rank; None while it can't send."""
        self._others: set[Rank] = set()

    def receive(
        self, message: RelayMessage, side: Side, *, echo: bool = False, by_bridge: bool = False
    ) -> RelayOutcome:
        """Take a valid message that was seen on `side`.

        `echo`: this bridge's own daemon reported it, so other nodes may not have it. `by_bridge`: a bridge put it
        there, so it must not be sent back.
        """
        fingerprint, to = message.fingerprint, side.other
        self._record_arrival(fingerprint, side, echo=echo)
        if by_bridge or fingerprint in self.queues[to] or self._is_known(fingerprint, to):
            self.counts[to]["known"] += 1
            return RelayOutcome.KNOWN
        active = active_bridge(self.own, self._others)
        queued = QueuedMessage(message, shared=bool(self._others), left_to=active, since=self._clock())
        if not self.queues[to].add(queued):
            self.dropped[to]["no-room"] += 1
            return RelayOutcome.QUEUE_FULL
        self.counts[to]["accepted"] += 1
        self.kinds[to][message.kind] += 1
        self._journal.add_waiting(to, queued)
        return RelayOutcome.ACCEPTED

    def sent(self, queued: QueuedMessage, side: Side, *, heard: bool) -> None:
        """This bridge sent the message to `side`. If nobody `heard` it, it is kept to be sent again."""
        message = queued.message
        self.counts[side]["carried"] += 1
        self.counts[side]["bytes"] += len(message.legacy if side is Side.IPFS else message.payload)
        waited = self.queues[side].arrived(message.fingerprint, now=self._clock())
        self._record(message.fingerprint, side, relayed=waited)
        if not heard:
            self._keep_unheard(queued, side)

    def refused(self, queued: QueuedMessage, side: Side) -> None:
        """The destination will never accept the message: drop it."""
        self.queues[side].drop(queued.message.fingerprint)
        self.dropped[side]["refused"] += 1
        self._journal.remove_waiting(queued.message.fingerprint)

    def drop_withdrawn(self, order: str, is_withdrawn: Callable[[RelayMessage], bool]) -> None:
        """A withdrawal of the order with this hash (hexadecimal) arrived: drop what waits and `is_withdrawn` now."""
        for side, queue in self.queues.items():
            for message in filter(is_withdrawn, queue.find(order)):
                queue.drop(message.fingerprint)
                self.invalid[side]["withdrawn"] += 1
                self._journal.remove_waiting(message.fingerprint)

    def restore(self) -> None:
        """Read the journal: the messages already relayed, and those that waited when the bridge stopped."""
        for fingerprint, age in self._journal.relayed():
            for side in Side:
                self._seen.add(fingerprint, side, age=age)
        for side, queued in list(self._journal.waiting()):
            if queued.shared and self._others:  # another bridge has sent it meanwhile
                self._journal.remove_waiting(queued.message.fingerprint)
                continue
            queued.since = self._clock()
            queued.left_to = active_bridge(self.own, self._others)
            self.queues[side].add(queued)

    def bridge_joined(self, rank: Rank) -> None:
        """Another bridge can send from now on."""
        self._others.add(rank)

    def bridge_left(self, rank: Rank) -> None:
        """Another bridge can't send any more, or has changed its rank."""
        self._others.discard(rank)
        successor = active_bridge(self.own, self._others)
        for queue in self.queues.values():
            queue.reassign(rank, successor, now=self._clock())

    def set_rank(self, own: Rank | None) -> None:
        """Set this bridge's rank; None while it can't send.

        If another bridge is active then, the messages that both hold are left to it. A bridge that was down or
        isolated did not see what others sent meanwhile, and does not send that again.
        """
        before, self.own = self.own, own
        active = active_bridge(own, self._others)
        is_back = own is not None and not own.isolated and (before is None or before.isolated)
        for side, queue in self.queues.items():
            if is_back and self._others:
                self._trust_others(side)
            if active is not None:
                queue.hand_over(active, now=self._clock())

    def take_overdue(self) -> int:
        """Take back messages that other bridges should have sent and did not. Returns their number."""
        if self.own is None or (self.own.isolated and any(not other.isolated for other in self._others)):
            return 0
        return sum(queue.take_overdue(now=self._clock()) for queue in self.queues.values())

    @property
    def others(self) -> frozenset[Rank]:
        """The ranks of the other bridges that can send now."""
        return frozenset(self._others)

    @property
    def is_active(self) -> bool:
        """Whether this bridge sends, rather than stands by."""
        return self.own is not None and active_bridge(self.own, self._others) is None

    def status(self, to: Side, *, per_second: float) -> DirectionStatus:
        """The counts of the direction towards `to`."""
        counts, queue = self.counts[to], self.queues[to]
        return DirectionStatus(
            received=counts["received"],
            invalid=dict(self.invalid[to]),
            known=counts["known"],
            accepted=counts["accepted"],
            carried=counts["carried"],
            left=counts["left"],
            dropped=dict(self.dropped[to]),
            waiting=len(queue),
            left_waiting=queue.left,
            unheard=queue.unheard,
            per_second=round(per_second, 2),
            kinds=dict(self.kinds[to]),
            bytes=counts["bytes"],
        )

    def _is_known(self, fingerprint: bytes, to: Side) -> bool:
        is_due = self._relayed[to].is_due(fingerprint)
        return self._seen.contains(fingerprint, to) if is_due is None else not is_due

    def _record_arrival(self, fingerprint: bytes, side: Side, *, echo: bool) -> None:
        queue = self.queues[side]
        arrived = queue.arrived(fingerprint, now=self._clock())
        if arrived and not echo:
            self.counts[side]["left"] += 1
        if not echo and queue.heard(fingerprint):
            self._journal.remove_waiting(fingerprint)
        self._record(fingerprint, side, relayed=arrived)

    def _record(self, fingerprint: bytes, side: Side, *, relayed: bool) -> None:
        """The message is on `side`; `relayed` if it waited to be sent there."""
        is_new = not self._seen.contains(fingerprint, side)
        self._seen.add(fingerprint, side)
        if relayed:
            self._relayed[side].add(fingerprint)
        if relayed or (is_new and self._seen.contains(fingerprint, side.other)):
            self._journal.mark_relayed(fingerprint)

    def _keep_unheard(self, queued: QueuedMessage, side: Side) -> None:
        self._journal.add_waiting(side, queued)
        if (dropped := self.queues[side].keep_unheard(queued)) is not None:
            self.dropped[side]["unheard"] += 1
            self._journal.remove_waiting(dropped.message.fingerprint)

    def _trust_others(self, side: Side) -> None:
        for fingerprint in self.queues[side].forget_left():
            self.counts[side]["left"] += 1
            self._journal.remove_waiting(fingerprint)

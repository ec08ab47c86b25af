"""What crosses between the two channels: each message once, by one bridge, and none that was accepted is lost. Pure.

A message that is seen on one side and not known on the other waits in the outbox to the other. There it is carried by
this bridge or, when another one has the better turn, left to it until it is seen to have arrived.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

from bridges.ipfs.memory import Memory, Side
from bridges.ipfs.outbox import Outbox, Waiting
from bridges.ipfs.turns import Turn, first_before
from schemas.status import DirectionStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ipfs.gate import Passenger

LIMIT: Final = 10_000
"""Messages that wait in one direction at most, some 15 MB."""


class Fate(Enum):
    """What became of a message that was seen on a side."""

    ACCEPTED = "accepted"
    """It waits to be carried to the other side, by this bridge or another."""
    KNOWN = "known"
    """It is on the other side, or waits to get there."""
    NO_ROOM = "no room"
    """It was not accepted: the outbox is full."""


class Notes(Protocol):
    """What is told of each message that waits, has crossed, or will not: see `Journal`."""

    def wait(self, to: Side, waiting: Waiting) -> None:
        """It waits from now on."""

    def crossed(self, fingerprint: bytes) -> None:
        """It is on both sides."""

    def given_up(self, fingerprint: bytes) -> None:
        """It is not waited with any more."""


class Traffic:
    """Both directions of one bridge. `clock` gives seconds; `limit` bounds each outbox; `notes` is kept up to date."""

    def __init__(self, clock: Callable[[], float], notes: Notes, *, limit: int = LIMIT) -> None:
        self._clock = clock
        self._notes = notes
        self.memory = Memory(clock)
        self.to: Final = {side: Outbox(limit=limit) for side in Side}
        self.counts: Final = {side: Counter[str]() for side in Side}
        """Counts of the direction towards each side."""
        self.invalid: Final = {side: Counter[str]() for side in Side}
        self.dropped: Final = {side: Counter[str]() for side in Side}
        self.kinds: Final = {side: Counter[str]() for side in Side}
        self.own: Turn | None = None
        self._others: set[Turn] = set()

    def seen(self, passenger: Passenger, side: Side, *, echo: bool = False, by_bridge: bool = False) -> Fate:
        """A valid message was seen on `side`.

        `echo`: this bridge's own daemon says it, so that nobody else need have heard it. `by_bridge`: a bridge brought
        it there, so that it is not to be brought back.
        """
        fingerprint, to = passenger.fingerprint, side.other
        self._note_arrival(fingerprint, side, echo=echo)
        if self.memory.knows(fingerprint, to) or fingerprint in self.to[to] or by_bridge:
            self.counts[to]["known"] += 1
            return Fate.KNOWN
        left_to = first_before(self.own, self._others)
        waiting = Waiting(passenger, shared=bool(self._others), left_to=left_to, since=self._clock())
        if not self.to[to].add(waiting):
            self.dropped[to]["no-room"] += 1
            return Fate.NO_ROOM
        self.counts[to]["accepted"] += 1
        self.kinds[to][passenger.kind] += 1
        self._notes.wait(to, waiting)
        return Fate.ACCEPTED

    def carried(self, waiting: Waiting, side: Side, *, heard: bool) -> None:
        """This bridge has put the message on `side`. If nobody `heard` it, it is kept to be said again."""
        fingerprint = waiting.passenger.fingerprint
        self.counts[side]["carried"] += 1
        self.counts[side]["bytes"] += len(waiting.passenger.legacy if side is Side.IPFS else waiting.passenger.payload)
        self.to[side].arrived(fingerprint, now=self._clock())
        self._note(fingerprint, side)
        if not heard and not self.to[side].said_to_nobody(waiting):
            self.dropped[side]["unheard"] += 1

    def refused(self, waiting: Waiting, side: Side) -> None:
        """The far side will never take the message."""
        self.to[side].drop(waiting.passenger.fingerprint)
        self.dropped[side]["refused"] += 1
        self._notes.given_up(waiting.passenger.fingerprint)

    def restore(self, waiting: Waiting, side: Side) -> bool:
        """A message that waited when the bridge ended; False if another one has surely carried it meanwhile."""
        if waiting.shared and self._others:
            self._notes.given_up(waiting.passenger.fingerprint)
            return False
        waiting.left_to = first_before(self.own, self._others)
        return self.to[side].add(waiting)

    def joined(self, turn: Turn) -> None:
        """Another bridge can carry from now on."""
        self._others.add(turn)

    def gone(self, turn: Turn) -> None:
        """It can't any more, or not with that turn."""
        self._others.discard(turn)
        heir = first_before(self.own, self._others)
        for outbox in self.to.values():
            outbox.gone(turn, heir, now=self._clock())

    def take_turn(self, own: Turn | None) -> None:
        """This bridge's turn from now on; None while it can't carry.

        What waits here and is known to a bridge that goes first now is left to it. Who was away, or without anybody to
        talk to, has not seen what others carried, and does not carry it again.
        """
        before, self.own = self.own, own
        first = first_before(own, self._others)
        for side, outbox in self.to.items():
            if own is not None and not own.deaf and (before is None or before.deaf) and self._others:
                self._trust_others(side)
            if first is not None:
                outbox.hand_over(first, now=self._clock())

    def look_after_left(self) -> int:
        """Take back what others should have carried and did not. How many messages they are."""
        if self.own is None or (self.own.deaf and any(not other.deaf for other in self._others)):
            return 0
        return sum(outbox.rescue(now=self._clock()) for outbox in self.to.values())

    @property
    def others(self) -> frozenset[Turn]:
        """The turns of the other bridges that can carry now."""
        return frozenset(self._others)

    def way(self, to: Side, *, per_second: float) -> DirectionStatus:
        """The direction towards `to` in figures."""
        counts, outbox = self.counts[to], self.to[to]
        return DirectionStatus(
            received=counts["received"],
            invalid=dict(self.invalid[to]),
            known=counts["known"],
            accepted=counts["accepted"],
            carried=counts["carried"],
            left=counts["left"],
            dropped=dict(self.dropped[to]),
            waiting=len(outbox),
            left_waiting=outbox.left,
            unheard=outbox.unheard,
            per_second=round(per_second, 2),
            kinds=dict(self.kinds[to]),
            bytes=counts["bytes"],
        )

    def _note_arrival(self, fingerprint: bytes, side: Side, *, echo: bool) -> None:
        outbox = self.to[side]
        if outbox.arrived(fingerprint, now=self._clock()):
            self.counts[side]["left"] += 1
        if not echo:
            outbox.heard(fingerprint)
        self._note(fingerprint, side)

    def _note(self, fingerprint: bytes, side: Side) -> None:
        news = not self.memory.knows(fingerprint, side)
        self.memory.note(fingerprint, side)
        if news and self.memory.knows(fingerprint, side.other):
            self._notes.crossed(fingerprint)

    def _trust_others(self, side: Side) -> None:
        for fingerprint in self.to[side].forget_left():
            self.counts[side]["left"] += 1
            self._notes.given_up(fingerprint)

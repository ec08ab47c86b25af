"""The order book: open demands and offers of one lighthouse, matched first come, first served. Pure: no I/O.

A demand and an offer agree when model, objective, token, cost, lighthouse and validator are equal. Orders wait in a
queue for each such set of terms and in another for each deadline, and know their places in both, so that adding,
matching, removing and expiring cost the same at a thousand open orders and at a million, and an order costs little more
than its text.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.market.queues import Link, Queues
from schemas import Demand, address_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from schemas import Offer, Verified

    Order = Demand | Offer
    Terms = tuple[str, str, str, int, str, str]

LIMIT: Final = 1_000_000
"""Open orders that a book holds unless told otherwise."""


class Refusal(StrEnum):
    """Why an order can't be taken, as published to its sender."""

    EXPIRED = "expired"
    """Its deadline is not ahead."""
    DUPLICATE = "duplicate"
    """It is open already."""
    LIGHTHOUSE = "lighthouse"
    """It is made for another lighthouse."""
    FULL = "full"
    """The book holds as many orders as it may; try again later."""


class Match(NamedTuple):
    """A demand and an offer that agree. Neither is open any more."""

    demand: Verified[Demand]
    offer: Verified[Offer]


@dataclass(frozen=True, slots=True)
class Added:
    """The order is open and waits for its counterpart."""

    order: Verified[Order]


def order_id(order: Verified[Order]) -> bytes:
    """What names an order in a book: hash and signer, since in generation 3 two people may sign equal terms."""
    return order.hash + address_bytes(order.signer)


class _Entry(NamedTuple):
    """An open order, and its places in the queue of its terms and in that of its deadline."""

    order: Verified[Order]
    among_terms: Link[Verified[Order]]
    among_deadlines: Link[Verified[Order]]


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    Not thread-safe. Every method is O(1) in the number of open orders, but for those that say otherwise.
    """

    def __init__(self, lighthouse: str, *, limit: int = LIMIT) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._head = 0
        self._entries: dict[bytes, _Entry] = {}
        self._demands: Queues[Terms, Verified[Order]] = Queues()
        self._offers: Queues[Terms, Verified[Order]] = Queues()
        self._deadlines: Queues[int, Verified[Order]] = Queues()

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._entries

    @property
    def head(self) -> int:
        """The latest block that the book was told of."""
        return self._head

    def add(self, order: Verified[Order]) -> Match | Added | Refusal:
        """Take a verified order: a `Match` with the longest waiting counterpart, or `Added`, or why it is refused."""
        message = order.message
        if message.lighthouse != self._lighthouse:
            return Refusal.LIGHTHOUSE
        if message.deadline <= self._head:
            return Refusal.EXPIRED
        identity = order_id(order)
        if identity in self._entries:
            return Refusal.DUPLICATE
        waiting = self._offers if isinstance(message, Demand) else self._demands
        counterpart = waiting.first(_terms(message))
        if counterpart is not None:
            self.remove(order_id(counterpart))
            return _match(order, counterpart)
        if len(self._entries) >= self._limit:
            return Refusal.FULL
        self._entries[identity] = _Entry(
            order,
            self._side(message).append(_terms(message), order),
            self._deadlines.append(message.deadline, order),
        )
        return Added(order)

    def remove(self, identity: bytes) -> Verified[Order] | None:
        """Take the order named `identity` out; None when it is not open."""
        entry = self._entries.pop(identity, None)
        if entry is None:
            return None
        message = entry.order.message
        self._side(message).remove(_terms(message), entry.among_terms)
        self._deadlines.remove(message.deadline, entry.among_deadlines)
        return entry.order

    def expire(self, head: int) -> list[Verified[Order]]:
        """Take out every order whose deadline is not after block `head`. O(blocks passed + orders expired).

        A lower `head` than before (a reorganised chain) takes nothing out and brings nothing back.
        """
        passed = range(self._head + 1, head + 1)
        self._head = max(self._head, head)
        due = passed if len(passed) < len(self._deadlines) else sorted(d for d in self._deadlines if d <= head)
        expired: list[Verified[Order]] = []
        for deadline in due:
            while (order := self._deadlines.first(deadline)) is not None:
                self.remove(order_id(order))
                expired.append(order)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book may not change meanwhile."""
        return (entry.order for entry in self._entries.values())

    def _side(self, message: Order) -> Queues[Terms, Verified[Order]]:
        return self._demands if isinstance(message, Demand) else self._offers


def _terms(order: Order) -> Terms:
    return (order.model, order.objective, order.token, order.cost, order.lighthouse, order.validator)


def _match(order: Verified[Order], other: Verified[Order]) -> Match:
    if isinstance(order.message, Demand):
        return Match(order, other)  # type: ignore[arg-type]
    return Match(other, order)  # type: ignore[arg-type]

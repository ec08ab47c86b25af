"""The order book: open demands and offers of one lighthouse, matched first come, first served. Pure: no I/O.

A demand and an offer agree when model, objective, token, cost, lighthouse, validator and generation are equal; the
book is of one lighthouse. Orders wait in a queue for each set of the other terms. Adding, matching and removing cost
the same at a thousand open orders and at a million, and an order costs little more than its text. What is due at a
block is a list of keys; an order that leaves earlier stays listed, by its key only, until then or until the lists are
made anew because most of what they hold has left.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.market.queues import Link, Queues
from schemas import Demand, address_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from schemas import Offer, Verified

    Order = Demand | Offer
    Terms = tuple[str, str, str, int, str, int]

HASH_SIZE: Final = 32
STALE: Final = 4096
"""Keys of orders that have left which may stay listed, beside as many as are open."""
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


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    Not thread-safe. Every method is O(1) in the number of open orders, but for those that say otherwise.
    """

    def __init__(self, lighthouse: str, *, limit: int = LIMIT) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._head = 0
        self._links: dict[bytes, Link[Verified[Order]]] = {}
        self._demands: Queues[Terms, Verified[Order]] = Queues()
        self._offers: Queues[Terms, Verified[Order]] = Queues()
        self._due: dict[int, list[bytes]] = {}
        self._listed = 0

    def __len__(self) -> int:
        return len(self._links)

    def __contains__(self, identity: bytes) -> bool:
        return self._key(identity) in self._links

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
        if order_id(order) in self:
            return Refusal.DUPLICATE
        waiting = self._offers if isinstance(message, Demand) else self._demands
        counterpart = waiting.first(_terms(message))
        if counterpart is not None:
            self.remove(order_id(counterpart.item))
            return _match(order, counterpart.item)
        if len(self._links) >= self._limit:
            return Refusal.FULL
        self._enter(order)
        return Added(order)

    def remove(self, identity: bytes) -> Verified[Order] | None:
        """Take the order named `identity` out; None when it is not open."""
        link = self._links.pop(self._key(identity), None)
        if link is None:
            return None
        message = link.item.message
        self._side(message).remove(_terms(message), link)
        return link.item

    def expire(self, head: int) -> list[Verified[Order]]:
        """Take out every order whose deadline is not after block `head`. O(blocks passed + orders expired).

        A lower `head` than before (a reorganised chain) takes nothing out and brings nothing back.
        """
        before, self._head = self._head, max(self._head, head)
        reached: Iterable[int] = range(before + 1, head + 1)
        if head - before > len(self._due):
            reached = sorted(block for block in self._due if block <= head)
        expired: list[Verified[Order]] = []
        for block in reached:
            keys = self._due.pop(block, [])
            self._listed -= len(keys)
            for key in keys:
                link = self._links.get(key)  # None, or another order, where the one due has left the book
                if link is not None and link.item.message.deadline == block:
                    self.remove(order_id(link.item))
                    expired.append(link.item)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book may not change meanwhile."""
        return (link.item for link in self._links.values())

    def _enter(self, order: Verified[Order]) -> None:
        message = order.message
        key = order.hash if order.hash not in self._links else order_id(order)
        link = self._links[key] = Link(order)
        self._side(message).append(_terms(message), link)
        self._list(key, message.deadline)
        if self._listed > STALE + 2 * len(self._links):
            self._list_anew()

    def _list(self, key: bytes, deadline: int) -> None:
        self._due.setdefault(deadline, []).append(key)
        self._listed += 1

    def _list_anew(self) -> None:
        """Forget the keys of those that have left: whoever posts orders chooses their deadlines, as late as he likes.

        O(open orders), but so many orders come between two times that it costs each of them little.
        """
        self._due.clear()
        self._listed = 0
        for key, link in self._links.items():
            self._list(key, link.item.message.deadline)

    def _key(self, identity: bytes) -> bytes:
        """Under what the order of this identity is or would be found.

        Mostly its hash alone, which the order holds anyway; a second signer's order of the same hash has all of it.
        """
        digest = identity[:HASH_SIZE]
        link = self._links.get(digest)
        return digest if link is not None and order_id(link.item) == identity else identity

    def _side(self, message: Order) -> Queues[Terms, Verified[Order]]:
        return self._demands if isinstance(message, Demand) else self._offers


def _terms(order: Order) -> Terms:
    return (order.model, order.objective, order.token, order.cost, order.validator, order.generation)


def _match(order: Verified[Order], other: Verified[Order]) -> Match:
    if isinstance(order.message, Demand):
        return Match(order, other)  # type: ignore[arg-type]
    return Match(other, order)  # type: ignore[arg-type]

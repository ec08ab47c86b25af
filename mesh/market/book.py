"""The order book: open demands and offers of one lighthouse, matched first come, first served. Pure: no I/O.

A demand and an offer match when model, objective, token, cost, lighthouse, validator and generation are equal. A book
serves one lighthouse, and has a queue of orders for each set of the other terms. Adding, matching and removing take
the same time at a thousand open orders and at a million; an order takes little more memory than its text.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.flood import KnownSenders
from mesh.market.queues import QueueNode, Queues, Share
from mesh.market.refusals import Refusal
from schemas import Demand, address_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from schemas import Offer, Verified

    Order = Demand | Offer
    Terms = tuple[str, str, str, int, str, int]

LIMIT: Final = 20_480
"""Open orders that a book holds by default: with up to 2 KB each, a provider stays below 200 MB."""
UNLIMITED: Final = 2**256


class Match(NamedTuple):
    """A demand and an offer with equal terms, which have left the book."""

    demand: Verified[Demand]
    offer: Verified[Offer]


@dataclass(frozen=True, slots=True)
class Added:
    """The order is in the book and waits for its counterpart. Others may have been evicted for it."""

    order: Verified[Order]
    evicted: tuple[Verified[Order], ...] = ()


def order_id(order: Verified[Any]) -> bytes:
    """The identity of an order or result: hash and signer, as several people may sign the same."""
    return order.hash + address_bytes(order.signer)


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    An order stays for `deadline_limit` blocks at most, even if its deadline is later. A full book makes room: first
    those orders leave that are not matched, or that pay nothing and whose signer is not `known`. Of these the signer
    with the most loses its newest; if none has more than one, the oldest leaves. If all others pay or are of known
    signers, only a signer with more orders than the new one's loses its newest.

    Not thread-safe. Methods are O(1) in the number of open orders, unless they say otherwise.
    """

    def __init__(self, lighthouse: str, *, limit: int = LIMIT, deadline_limit: int = UNLIMITED) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._deadline_limit = deadline_limit
        self._head = 0
        self._nodes: dict[bytes, _BookNode] = {}
        self.known: Final = KnownSenders()
        """The accounts that a liability was created for: their orders leave last."""
        self._first, self._last = Share(), Share()
        """The orders that leave a full book first, and the others."""
        self._demands: Queues[Terms, Verified[Order]] = Queues()
        self._offers: Queues[Terms, Verified[Order]] = Queues()
        self._aside: set[bytes] = set()
        """Orders in the book that are not matched."""
        self._due: Queues[int, bytes] = Queues()
        """The identities of the orders that leave in each block."""

    def __len__(self) -> int:
        return len(self._nodes)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._nodes

    @property
    def head(self) -> int:
        """The latest block that `expire` was called with."""
        return self._head

    def add(self, order: Verified[Order]) -> Match | Added | Refusal:
        """Add a verified order. Returns a `Match` with the oldest counterpart, `Added`, or the reason of a refusal."""
        message = order.message
        if (refusal := self._refusal(order)) is not None:
            return refusal
        waiting = self._offers if isinstance(message, Demand) else self._demands
        counterpart = waiting.first(_terms(message))
        if counterpart is not None:
            self.remove(order_id(counterpart.item))
            return _match(order, counterpart.item)
        evicted = self._make_room(order)
        if evicted is None:
            return Refusal.FULL
        self._enter(order)
        return Added(order, evicted)

    def set_aside(self, order: Verified[Order]) -> bool:
        """Add an order that is not matched until it is removed and added; False if the book refuses it."""
        if self._refusal(order) is not None or len(self._nodes) >= self._limit:
            return False
        self._aside.add(order_id(order))
        self._enter(order)
        return True

    def remove(self, identity: bytes) -> Verified[Order] | None:
        """Remove and return the order with this identity; None if it is not in the book."""
        node = self._nodes.pop(identity, None)
        if node is None:
            return None
        self._due.remove(node.due, node.of_due)
        share = self._first if identity in self._first else self._last
        share.remove(identity, node.item.signer, node.of_signer)
        if identity in self._aside:
            self._aside.remove(identity)
        else:
            self._side(node.item.message).remove(_terms(node.item.message), node)
        return node.item

    def stays(self, identity: bytes) -> bool:
        """Whether the order with this identity is in the book, and leaves it last when it is full."""
        return identity in self._last

    def expire(self, head: int) -> list[Verified[Order]]:
        """Remove and return every order whose deadline, or time in the book, is not after block `head`.

        O(blocks passed + orders expired). A lower `head` than before (after a reorganisation) changes nothing.
        """
        before, self._head = self._head, max(self._head, head)
        reached: Iterable[int] = range(before + 1, head + 1)
        if head - before > len(self._nodes):
            reached = sorted({node.due for node in self._nodes.values() if node.due <= head})
        expired: list[Verified[Order]] = []
        for block in reached:
            while (node := self._due.first(block)) is not None and (order := self.remove(node.item)) is not None:
                expired.append(order)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book must not change during the iteration."""
        return (node.item for node in self._nodes.values())

    def of(self, signer: str) -> list[Verified[Order]]:
        """The open orders of a signer. O(those orders)."""
        return [self._nodes[identity].item for share in (self._first, self._last) for identity in share.of(signer)]

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        message = order.message
        if message.lighthouse != self._lighthouse:
            return Refusal.LIGHTHOUSE
        expired = message.deadline <= self._head
        return Refusal.EXPIRED if expired else Refusal.DUPLICATE if order_id(order) in self else None

    def _enter(self, order: Verified[Order]) -> None:
        message, identity = order.message, order_id(order)
        due = min(message.deadline, self._head + self._deadline_limit)
        node = self._nodes[identity] = _BookNode(order, due, identity)
        if identity not in self._aside:
            self._side(message).append(_terms(message), node)
        self._due.append(node.due, node.of_due)
        self._share_of(order).add(identity, order.signer, node.of_signer)

    def _share_of(self, order: Verified[Order]) -> Share:
        stays = order_id(order) not in self._aside and (_pays(order.message) or order.signer in self.known)
        return self._last if stays else self._first

    def _make_room(self, order: Verified[Order]) -> tuple[Verified[Order], ...] | None:
        """Evict an order if the book is full, and return it; None if the new one has no better right to a place."""
        if len(self._nodes) < self._limit:
            return ()
        share, own = self._first if self._first else self._last, self._share_of(order)
        if own is not share and own is self._first:
            return None
        victim = share.victim(order.signer if own is share else "", or_oldest=share is self._first)
        if victim is None:
            return None
        evicted = self.remove(victim)
        assert evicted is not None
        return (evicted,)

    def _side(self, message: Order) -> Queues[Terms, Verified[Order]]:
        return self._demands if isinstance(message, Demand) else self._offers


class _BookNode(QueueNode["Verified[Order]"]):
    """An order in a book, when it leaves, and the nodes of its identity by signer and by block."""

    __slots__ = ("due", "of_due", "of_signer")

    def __init__(self, order: Verified[Order], due: int, identity: bytes) -> None:
        super().__init__(order)
        self.due = due
        self.of_due, self.of_signer = QueueNode(identity), QueueNode(identity)


def _pays(order: Order) -> bool:
    """Whether an order costs its maker something, which makes a flood of such orders expensive."""
    return (order.cost + order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee) > 0


def _terms(order: Order) -> Terms:
    return (order.model, order.objective, order.token, order.cost, order.validator, order.generation)


def _match(order: Verified[Order], other: Verified[Order]) -> Match:
    if isinstance(order.message, Demand):
        return Match(order, other)  # type: ignore[arg-type]
    return Match(other, order)  # type: ignore[arg-type]

"""The order book: open demands and offers of one lighthouse, matched first come, first served. Pure: no I/O.

A demand and an offer match when model, objective, token, cost, lighthouse, validator and generation are equal. A book
serves one lighthouse, and has a queue of orders for each set of the other terms. Adding, matching and removing take
the same time at a thousand open orders and at a million; an order takes little more memory than its text.

For each deadline there is a list of the keys of orders that expire then. The key of one that left earlier stays there
until the deadline, or until the lists are rebuilt because most of their orders have left.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.market.queues import QueueNode, Queues
from schemas import Demand, address_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from schemas import Offer, Verified

    Order = Demand | Offer
    Terms = tuple[str, str, str, int, str, int]

HASH_SIZE: Final = 32
STALE: Final = 4096
"""Keys of orders that left the book which may stay in the lists, in addition to as many as are open."""
LIMIT: Final = 1_000_000
"""Open orders that a book holds by default."""
UNLIMITED: Final = 2**256
ORDER_USED: Final = "OrderUsed"
"""The contracts' error for an order that became a liability, or was withdrawn there."""
UNNAMED_ERROR: Final = "Reverted"
"""The reason of a rejection when the contract's error has no name."""


class Refusal(StrEnum):
    """Why the book refuses an order, as published to its sender."""

    EXPIRED = "expired"
    """Its deadline has passed."""
    DUPLICATE = "duplicate"
    """It is in the book already."""
    LIGHTHOUSE = "lighthouse"
    """It names another lighthouse."""
    FULL = "full"
    """The book is full; try again later."""
    WITHDRAWN = "withdrawn"
    """Its maker has withdrawn it."""
    BLOCKED = "blocked"
    """Its maker is blocked; this is not published."""


class Match(NamedTuple):
    """A demand and an offer with equal terms, which have left the book."""

    demand: Verified[Demand]
    offer: Verified[Offer]


@dataclass(frozen=True, slots=True)
class Added:
    """The order is in the book and waits for its counterpart. Others may have been evicted for it."""

    order: Verified[Order]
    evicted: tuple[Verified[Order], ...] = ()


def order_id(order: Verified[Order]) -> bytes:
    """The identity of an order in a book: hash and signer, as in generation 3 two people may sign equal terms."""
    return order.hash + address_bytes(order.signer)


class OrderBook:
    """The open orders of the lighthouse at `lighthouse` (EIP-55 address), `limit` of them at most.

    An order stays for `deadline_limit` blocks at most, even if its deadline is later. A full book makes room: the
    signer with the most orders loses its newest; if none has more than one, the oldest order that is not matched, or
    that pays nothing, leaves.

    Not thread-safe. Methods are O(1) in the number of open orders, unless they say otherwise.
    """

    def __init__(self, lighthouse: str, *, limit: int = LIMIT, deadline_limit: int = UNLIMITED) -> None:
        self._lighthouse = lighthouse
        self._limit = limit
        self._deadline_limit = deadline_limit
        self._head = 0
        self._nodes: dict[bytes, _BookNode] = {}
        self._signers: Queues[str, bytes] = Queues()
        """The keys of each signer's orders, oldest first."""
        self._numbers: Counter[str] = Counter()
        """How many orders each signer has."""
        self._heaviest = ""
        """The signer that had the most orders when it added one."""
        self._unpaid: dict[bytes, None] = {}
        """The keys of orders that are not matched or pay nothing, oldest first."""
        self._demands: Queues[Terms, Verified[Order]] = Queues()
        self._offers: Queues[Terms, Verified[Order]] = Queues()
        self._aside: set[bytes] = set()
        """Orders in the book that are not matched."""
        self._due: dict[int, list[bytes]] = {}
        self._listed = 0

    def __len__(self) -> int:
        return len(self._nodes)

    def __contains__(self, identity: bytes) -> bool:
        return self._key(identity) in self._nodes

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
        key = self._key(identity)
        node = self._nodes.pop(key, None)
        if node is None:
            return None
        message, signer = node.item.message, node.item.signer
        self._signers.remove(signer, node.of_signer)
        self._numbers[signer] -= 1
        if not self._numbers[signer]:
            del self._numbers[signer]
        self._unpaid.pop(key, None)
        if identity in self._aside:
            self._aside.remove(identity)
        else:
            self._side(message).remove(_terms(message), node)
        return node.item

    def expire(self, head: int) -> list[Verified[Order]]:
        """Remove and return every order whose deadline, or time in the book, is not after block `head`.

        O(blocks passed + orders expired).

        A lower `head` than before (after a reorganisation) changes nothing.
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
                node = self._nodes.get(key)  # None, or another order, if the one listed has left the book
                if node is not None and node.due == block:
                    self.remove(order_id(node.item))
                    expired.append(node.item)
        return expired

    def orders(self) -> Iterator[Verified[Order]]:
        """The open orders, oldest first. O(orders); the book must not change during the iteration."""
        return (node.item for node in self._nodes.values())

    def of(self, signer: str) -> list[Verified[Order]]:
        """The open orders of a signer. O(those orders)."""
        return [self._nodes[key].item for key in self._signers.items(signer)]

    def _refusal(self, order: Verified[Order]) -> Refusal | None:
        message = order.message
        if message.lighthouse != self._lighthouse:
            return Refusal.LIGHTHOUSE
        expired = message.deadline <= self._head
        return Refusal.EXPIRED if expired else Refusal.DUPLICATE if order_id(order) in self else None

    def _enter(self, order: Verified[Order]) -> None:
        message = order.message
        key = order.hash if order.hash not in self._nodes else order_id(order)
        node = self._nodes[key] = _BookNode(order, min(message.deadline, self._head + self._deadline_limit), key)
        if order_id(order) not in self._aside:
            self._side(message).append(_terms(message), node)
        if order_id(order) in self._aside or not _pays(message):
            self._unpaid[key] = None
        self._signers.append(order.signer, node.of_signer)
        self._numbers[order.signer] += 1
        if self._numbers[order.signer] >= self._numbers.get(self._heaviest, 0):
            self._heaviest = order.signer
        self._list(key, node.due)
        if self._listed > STALE + 2 * len(self._nodes):
            self.compact()

    def _make_room(self, order: Verified[Order]) -> tuple[Verified[Order], ...] | None:
        """Evict an order if the book is full, and return it; None if the new one has no better right to a place."""
        if len(self._nodes) < self._limit:
            return ()
        most = self._numbers.get(self._heaviest, 0)
        if self._numbers.get(order.signer, 0) >= max(most, 1):
            return None
        if most > 1:
            last = self._signers.first(self._heaviest)
            assert last is not None
            key = last.before.item
        elif self._unpaid:
            key = next(iter(self._unpaid))
        else:
            return None
        evicted = self.remove(order_id(self._nodes[key].item))
        assert evicted is not None
        return (evicted,)

    def _list(self, key: bytes, deadline: int) -> None:
        self._due.setdefault(deadline, []).append(key)
        self._listed += 1

    def compact(self) -> None:
        """Rebuild the lists without the keys of orders that left. O(open orders), but rare."""
        self._due.clear()
        self._listed = 0
        for key, node in self._nodes.items():
            self._list(key, node.due)

    def _key(self, identity: bytes) -> bytes:
        """The key of the order with this identity, whether it is in the book or not.

        It is the hash, which the order holds anyway; for another signer's order with the same hash, the identity.
        """
        digest = identity[:HASH_SIZE]
        node = self._nodes.get(digest)
        return digest if node is not None and order_id(node.item) == identity else identity

    def _side(self, message: Order) -> Queues[Terms, Verified[Order]]:
        return self._demands if isinstance(message, Demand) else self._offers


class _BookNode(QueueNode["Verified[Order]"]):
    """An order in a book, the block in which it leaves, and the node of its key among its signer's."""

    __slots__ = ("due", "of_signer")

    def __init__(self, order: Verified[Order], due: int, key: bytes) -> None:
        super().__init__(order)
        self.due = due
        self.of_signer = QueueNode(key)


def at_fault(match: Match, error: str, arguments: Sequence[Any]) -> tuple[Verified[Order], ...]:
    """The orders that caused the contracts' `error` (name of a custom error) when the match was to be a liability.

    Both orders, if the error and its arguments don't tell them apart.
    """
    both: tuple[Verified[Order], ...] = (match.demand, match.offer)
    match error, *arguments:
        case name, used if name == ORDER_USED:
            return tuple(order for order in both if order.hash == _bytes(used)) or both
        case "DeadlineReached", deadline:
            return tuple(order for order in both if order.message.deadline == deadline) or both
        case "WrongSigner" | "ERC20InsufficientBalance", str(address), *_:
            return tuple(order for order in both if address_bytes(order.signer) == address_bytes(address)) or both
        case "InvalidSignature", *_:
            return both
        case "ERC20InsufficientAllowance", _, _, needed if needed == match.offer.message.lighthouse_fee:
            return both if needed in (match.demand.message.cost, match.demand.message.validator_fee) else (match.offer,)
        case "ERC20InsufficientAllowance" | "ValidatorWithoutCode", *_:
            return (match.demand,)
    return both


def reason_word(error: str) -> str:
    """The machine-readable reason for a contract's error: its name, but never a text that a stranger's token chose."""
    return error if error.isidentifier() else UNNAMED_ERROR


def _bytes(value: bytes | str) -> bytes:
    return bytes.fromhex(value.removeprefix("0x")) if isinstance(value, str) else bytes(value)


def _pays(order: Order) -> bool:
    """Whether an order costs its maker something, which makes a flood of such orders expensive."""
    return (order.cost + order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee) > 0


def _terms(order: Order) -> Terms:
    return (order.model, order.objective, order.token, order.cost, order.validator, order.generation)


def _match(order: Verified[Order], other: Verified[Order]) -> Match:
    if isinstance(order.message, Demand):
        return Match(order, other)  # type: ignore[arg-type]
    return Match(other, order)  # type: ignore[arg-type]

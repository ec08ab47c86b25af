"""Random operations on the order book, compared with a naive book."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from mesh.market import Added, Match, OrderBook, order_id
from schemas import Demand, Offer, Verified, verify_message
from schemas.signing import Refusal
from tests.support.orders import LIGHTHOUSE, PERSON, ROBOT, TOKEN, terms, verified_demand, verified_offer

if TYPE_CHECKING:
    from mesh.market.book import Order


class NaiveBook:
    """The same rules, with lists that are searched from end to end."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.head = 0
        self.open: list[Verified[Order]] = []

    def add(self, order: Verified[Order]) -> Match | Added | Refusal:
        if order.message.lighthouse != LIGHTHOUSE:
            return Refusal.LIGHTHOUSE
        if order.message.deadline <= self.head:
            return Refusal.EXPIRED
        if order in self.open:
            return Refusal.DUPLICATE
        for other in self.open:
            if type(other.message) is not type(order.message) and agree(other.message, order.message):
                self.open.remove(other)
                pair = (order, other) if isinstance(order.message, Demand) else (other, order)
                return Match(*pair)  # type: ignore[arg-type]
        if len(self.open) >= self.limit:
            return Refusal.FULL
        self.open.append(order)
        return Added(order)

    def remove(self, order: Verified[Order]) -> Verified[Order] | None:
        if order not in self.open:
            return None
        self.open.remove(order)
        return order

    def expire(self, head: int) -> list[Verified[Order]]:
        self.head = max(self.head, head)
        due = sorted((o for o in self.open if o.message.deadline <= head), key=lambda order: order.message.deadline)
        self.open = [order for order in self.open if order not in due]
        return due


def agree(one: Order, other: Order) -> bool:
    fields = ("model", "objective", "token", "cost", "lighthouse", "validator", "generation")
    return all(getattr(one, field) == getattr(other, field) for field in fields)


def pool() -> list[Verified[Any]]:
    """Orders that often match, expire together, have two signers, or name another lighthouse."""
    orders: list[Verified[Any]] = []
    for cost in (1, 2):
        for deadline in (3, 4, 8, 9):
            for twin in range(2):
                same = terms(cost=cost, deadline=deadline, nonce=f"{twin + 1:064d}")
                for signer in (PERSON, ROBOT):
                    orders.append(verify_message(signer.sign(Demand(**same, validator_fee=0))))
                    orders.append(verify_message(signer.sign(Offer(**same, lighthouse_fee=0))))
            fifth: dict[str, Any] = {"cost": cost, "deadline": deadline, "nonce": 1}
            orders.append(verified_demand(sender=PERSON.address, **fifth))
            orders.append(verified_offer(sender=ROBOT.address, **fifth))
    return [*orders, verified_demand(lighthouse=TOKEN)]


POOL = pool()


class BookAgainstNaiveBook(RuleBasedStateMachine):
    """After any operations the book returns and holds the same as the naive one."""

    @initialize(limit=st.sampled_from([1, 3, 8, 100]))
    def begin(self, limit: int) -> None:
        self.book = OrderBook(LIGHTHOUSE, limit=limit)
        self.naive = NaiveBook(limit)

    @rule(order=st.sampled_from(POOL))
    def add(self, order: Verified[Any]) -> None:
        outcome, naive = self.book.add(order), self.naive.add(order)
        if isinstance(outcome, Added) and outcome.evicted:
            self.has_evicted(order, outcome)
        else:
            assert outcome == naive

    def has_evicted(self, order: Verified[Any], outcome: Added) -> None:
        """A full book has made room: by an order that pays nothing, while there is one.

        It was for one that pays, or of a signer with fewer orders of this sort, and the loser's newest or the oldest.
        """
        (evicted,) = outcome.evicted
        free = [one for one in self.naive.open if isinstance(one.message, Offer)]
        share = free or self.naive.open
        numbers = Counter(one.signer for one in share)
        assert len(self.naive.open) == self.naive.limit
        pays_more = bool(free) and isinstance(order.message, Demand)
        assert pays_more or numbers[order.signer] < numbers[evicted.signer]
        assert evicted == [one for one in share if one.signer == evicted.signer][-1] or evicted == free[0]
        self.naive.open.remove(evicted)
        self.naive.open.append(order)

    @rule(order=st.sampled_from(POOL))
    def remove(self, order: Verified[Any]) -> None:
        assert self.book.remove(order_id(order)) == self.naive.remove(order)

    @rule(head=st.integers(0, 10))
    def expire(self, head: int) -> None:
        assert by_deadline(self.book.expire(head)) == by_deadline(self.naive.expire(head))

    @invariant()
    def holds_the_same(self) -> None:
        assert list(self.book.orders()) == self.naive.open
        assert len(self.book) == len(self.naive.open)
        assert self.book.head == self.naive.head
        assert [order for order in POOL if order_id(order) in self.book] == [
            order for order in POOL if order in self.naive.open
        ]


def by_deadline(orders: list[Verified[Any]]) -> list[tuple[int, set[bytes]]]:
    """The deadlines in their order, with the orders that expired at each."""
    deadlines = [order.message.deadline for order in orders]
    assert deadlines == sorted(deadlines)
    return [
        (deadline, {order_id(order) for order in orders if order.message.deadline == deadline})
        for deadline in dict.fromkeys(deadlines)
    ]


TestBookAgainstNaiveBook = BookAgainstNaiveBook.TestCase
TestBookAgainstNaiveBook.settings = settings(max_examples=60, stateful_step_count=60, deadline=None)

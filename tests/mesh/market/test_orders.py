"""The record of each order and result at a provider."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from mesh.base.retry import RetryPolicy
from mesh.market import Added, Match, order_id
from mesh.market._orders import OrderLimits, Orders
from mesh.market.book import ENDS, TRANSITIONS, OrderRecord, OrderStage
from schemas import Demand, Offer, Result, verify_message
from schemas.signing import Refusal
from tests.support.orders import (
    CONTRACT,
    LIGHTHOUSE,
    MODEL,
    OBJECTIVE,
    OTHER_MODEL,
    PERSON,
    ROBOT,
    result,
    verified_demand,
    verified_offer,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from schemas import Verified

DEPTH = 3
OTHER = "0x27023154114b066515Ae678cb06E19417B8fcA73"
HOURLY = RetryPolicy(initial=3600.0, ceiling=3600.0)


def orders_with(*begun: Verified[Any], **options: Any) -> Orders:
    orders = Orders(LIGHTHOUSE, depth=DEPTH, **options)
    orders.begin(*begun)
    return orders


def states(orders: Orders, *messages: Verified[Any]) -> list[OrderStage | None]:
    return [orders.state(order_id(message)) for message in messages]


def test_a_message_without_an_event_leaves_when_its_transaction_ends() -> None:
    orders = orders_with(demand := verified_demand())
    assert orders.settling(order_id(demand)) == demand
    assert not orders.is_read(demand, until=100)
    assert not orders.end(demand)
    assert states(orders, demand) == [None]


def test_an_offer_stays_with_its_first_demand_and_a_demand_may_get_another_offer() -> None:
    orders, (demand, other), (offer, later) = orders_with(), _two(verified_demand), _two(verified_offer)
    assert orders.pair(Match(demand, offer), head=0) is None
    assert orders.pair(Match(demand, offer), head=0) is Refusal.DUPLICATE
    assert not orders.end(demand)
    assert not orders.end(offer)
    assert orders.pair(Match(other, offer), head=0) is Refusal.DUPLICATE
    assert not orders.is_paired(other)
    assert orders.pair(Match(demand, later), head=0) is None
    assert orders.is_pair(Match(demand, later))
    assert [orders.is_paired(one) for one in (demand, later, offer)] == [True, True, False]


def test_an_offer_goes_on_with_what_is_signed_in_place_of_its_demand() -> None:
    """In generation 5 a demand whose nonce another order has used is signed again, and the offer need not be."""
    orders, offer = orders_with(), verified_offer(nonce=3, sender=ROBOT.address)
    first, again = (verified_demand(nonce=nonce, sender=PERSON.address) for nonce in (7, 8))
    costlier = verified_demand(nonce=9, sender=PERSON.address, cost=2)
    of_another = verified_demand(signer=ROBOT, nonce=9, sender=ROBOT.address)
    assert orders.pair(Match(first, offer), head=0) is None
    for order in (first, offer):
        orders.end(order)
    assert [orders.pair(Match(one, offer), head=0) for one in (costlier, of_another)] == [Refusal.DUPLICATE] * 2
    assert orders.pair(Match(again, offer), head=0) is None
    assert orders.is_pair(Match(again, offer))
    for order in (again, offer):
        orders.end(order)
    assert orders.pair(Match(first, offer), head=0) is Refusal.REPLACED
    assert orders.is_pair(Match(again, offer))


def test_a_pair_takes_its_orders_out_of_the_book() -> None:
    orders, (demand, other), (offer, _) = orders_with(), _two(verified_demand), _two(verified_offer)
    assert isinstance(orders.add(demand, head=0), Added)
    assert orders.pair(Match(demand, offer), head=0) is None
    assert states(orders, demand, offer) == [OrderStage.MATCHED] * 2
    assert len(orders.book) == 0
    orders.book.expire(2_000_000)
    assert orders.pair(Match(other, verified_offer()), head=0) is Refusal.EXPIRED


def test_only_the_latest_pairs_and_versions_are_remembered() -> None:
    orders = orders_with(limits=OrderLimits(remembered=2))
    pairs = [Match(verified_demand(), verified_offer()) for _ in range(2)]
    assert [orders.pair(pair, head=0) for pair in pairs] == [None, None]
    assert [orders.is_pair(pair) for pair in pairs] == [False, True]


def _two(make: Callable[[], Verified[Any]]) -> tuple[Verified[Any], Verified[Any]]:
    return make(), make()


def test_a_match_is_under_settlement_and_no_copy_of_it_is_taken() -> None:
    orders, demand, offer = orders_with(), verified_demand(), verified_offer()
    assert isinstance(orders.add(demand, head=0), Added)
    assert orders.add(offer, head=0) == Match(demand, offer)
    assert states(orders, demand, offer) == [OrderStage.MATCHED] * 2
    assert orders.add(demand, head=0) is Refusal.DUPLICATE
    assert not orders.set_aside(demand, now=0.0, head=0)
    assert [one.identity for one in orders.sending(demand, offer)] == [order_id(demand), order_id(offer)]
    assert states(orders, demand, offer) == [OrderStage.SENDING] * 2
    assert len(orders.book) == 0


def test_used_messages_stay_until_their_event_is_deep() -> None:
    orders, demand, offer = orders_with(), verified_demand(), verified_offer(cost=7)
    orders.begin(demand)
    orders.add(offer, head=0)
    for one in (demand, offer):
        orders.created(CONTRACT, 10, order_id(one))
    assert states(orders, demand, offer) == [OrderStage.MINED, OrderStage.CONFIRMED]
    assert (orders.is_read(demand, until=9), orders.is_read(demand, until=10)) == (False, True)
    assert orders.end(demand)
    orders.confirm(12)
    assert states(orders, demand, offer) == [OrderStage.CONFIRMED] * 2
    orders.confirm(13)
    assert states(orders, demand, offer) == [None, None]
    assert orders.reverted(CONTRACT, Demand, Offer) == []


def test_a_message_whose_transaction_waits_does_not_leave() -> None:
    orders = orders_with(ended := verify_message(result(liability=CONTRACT)))
    orders.finalized(CONTRACT, 10)
    orders.confirm(100)
    assert orders.is_read(ended, until=10)
    assert orders.reverted(CONTRACT, Result) == []
    assert not orders.is_read(ended, until=100)
    orders.finalized(CONTRACT, 11)
    assert orders.end(ended)
    orders.confirm(14)
    assert states(orders, ended) == [None]


def test_reverted_messages_are_returned_once_and_by_kind() -> None:
    orders, demand = orders_with(ended := verify_message(result(liability=CONTRACT))), verified_demand()
    orders.add(demand, head=0)
    orders.created(CONTRACT, 10, order_id(demand))
    orders.finalized(CONTRACT, 11)
    orders.end(ended)
    assert orders.reverted(OTHER, Demand, Result) == []
    assert orders.reverted(CONTRACT, Result) == [ended]
    assert orders.reverted(CONTRACT, Demand, Offer) == [demand]
    assert orders.reverted(CONTRACT, Demand, Offer, Result) == []


def test_an_order_that_another_contract_uses_after_a_reorganisation_belongs_to_that_one() -> None:
    orders = orders_with(demand := verified_demand())
    orders.created(CONTRACT, 10, order_id(demand))
    orders.reverted(CONTRACT, Demand)
    orders.created(OTHER, 11, order_id(demand))
    orders.end(demand)
    assert orders.reverted(CONTRACT, Demand) == []
    assert orders.reverted(OTHER, Demand) == [demand]


def test_the_number_of_used_messages_is_bounded() -> None:
    demands = [verified_demand() for _ in range(3)]
    orders = orders_with(limits=OrderLimits(used=2))
    for block, demand in enumerate(demands, 10):
        orders.add(demand, head=0)
        orders.created(CONTRACT, block, order_id(demand))
    orders.confirm(12)
    assert states(orders, *demands) == [None, OrderStage.CONFIRMED, OrderStage.CONFIRMED]


def test_results_wait_for_others_until_one_is_sent() -> None:
    orders = orders_with()
    one, other = (verify_message(result(liability=CONTRACT, success=success)) for success in (True, False))
    orders.hold(one)
    orders.hold(other)
    assert orders.held(CONTRACT) == [one, other]
    orders.begin(one)
    assert orders.held(CONTRACT) == []
    orders.release(other)
    assert states(orders, one, other) == [OrderStage.MATCHED, None]


def test_the_oldest_result_that_waits_leaves_for_one_too_many() -> None:
    orders = orders_with(limits=OrderLimits(held=1))
    sent, old, new = (verify_message(result(liability=CONTRACT, result=cid)) for cid in (OBJECTIVE, MODEL, OTHER_MODEL))
    assert orders.hold(sent) is None
    orders.begin(sent)
    assert orders.hold(sent) is None, "another copy does not wait"
    assert orders.hold(old) is None
    assert orders.hold(new) == old
    assert states(orders, sent, old, new) == [OrderStage.MATCHED, None, OrderStage.RECEIVED]


def test_makers_that_can_not_pay_are_asked_after_until_they_can() -> None:
    orders = orders_with(limits=OrderLimits(unfunded=2), retry=HOURLY)
    demand, gone, full = (verified_demand() for _ in range(3))
    assert [orders.set_aside(one, now=0.0, head=0) for one in (demand, gone, full)] == [True, True, False]
    assert orders.set_aside(demand, now=0.0, head=0), "it is there"
    orders.book.remove(order_id(gone))
    assert orders.to_look_at(0.0, 9) == []
    (record,) = orders.to_look_at(3600.0, 9)
    assert orders.looked_at(record, is_funded=False, now=3600.0) is None
    assert orders.to_look_at(3600.0, 9) == []
    (record,) = orders.to_look_at(7200.0, 9)
    assert orders.looked_at(record, is_funded=True, now=7200.0) == demand
    assert len(orders.book) == 0


def test_a_limited_number_of_makers_is_asked_after_at_once() -> None:
    orders, demands = orders_with(), [verified_demand() for _ in range(5)]
    for demand in demands:
        orders.set_aside(demand, now=0.0, head=0)
    due = [len(orders.to_look_at(10.0, 3)) for _ in range(3)]
    assert due == [3, 2, 0]


def test_a_copy_of_an_unfunded_order_is_matched_once_its_maker_can_pay() -> None:
    orders, demand, offer = orders_with(), verified_demand(), verified_offer()
    orders.set_aside(demand, now=0.0, head=0)
    assert isinstance(orders.add(offer, head=0), Added)
    assert orders.add(demand, head=0) == Match(demand, offer)


def test_a_used_order_is_forgotten_when_its_own_block_is_deep() -> None:
    """Also if the transaction of another one, in a later block, was waited for less long."""
    orders, demand, offer = orders_with(), verified_demand(), verified_offer()
    assert isinstance(orders.add(demand, head=1), Added)
    assert orders.add(offer, head=1) == Match(demand, offer)
    for block, order in ((2, offer), (3, demand)):
        orders.created(CONTRACT, block, order_id(order))
    for order in (demand, offer):
        assert orders.end(order)
    orders.confirm(2 + DEPTH)
    assert states(orders, demand, offer) == [OrderStage.CONFIRMED, None]


@pytest.mark.parametrize("state", sorted(ENDS))
def test_nothing_follows_an_end(state: OrderStage) -> None:
    record = OrderRecord(verified_demand())
    record.move(state)
    with pytest.raises(AssertionError):
        record.move(OrderStage.OPEN)


def test_each_state_can_be_reached_and_left() -> None:
    assert set(TRANSITIONS) == set(OrderStage)
    assert set().union(*TRANSITIONS.values()) == set(OrderStage)


class Model:
    """What a provider should know of its orders: the states of those with a record, and which contract used them."""

    def __init__(self) -> None:
        self.states: dict[bytes, str] = {}
        self.used: dict[bytes, tuple[str, int]] = {}
        self.withdrawn: set[bytes] = set()
        self.queue: list[Verified[Any]] = []

    def add(self, order: Verified[Any]) -> None:
        identity = order_id(order)
        if self.states.get(identity, "unfunded") != "unfunded" or identity in self.withdrawn:
            return
        others = [one for one in self.queue if one.message.kind != order.message.kind]
        for one in (order, *others[:1]):
            self.states[order_id(one)] = "matched" if others else "open"
        self.queue = [one for one in (*self.queue, order) if self.states[order_id(one)] == "open"]

    def leave(self, identity: bytes) -> None:
        self.states.pop(identity, None)
        self.used.pop(identity, None)
        self.queue = [one for one in self.queue if order_id(one) != identity]


ORDERS: list[Verified[Any]] = [
    *(verified_demand(deadline=99) for _ in range(3)),
    *(verified_offer(deadline=99) for _ in range(3)),
]
WHICH = st.sampled_from(ORDERS)


class OrdersAgainstTheirModel(RuleBasedStateMachine):
    """Orders come, match, become contracts, are reverted, are withdrawn, in whatever sequence."""

    def __init__(self) -> None:
        super().__init__()
        self.model = Model()
        self.orders = Orders(LIGHTHOUSE, depth=DEPTH, withdrawn=self.model.withdrawn)
        self.head = 1

    def in_state(self, *names: str) -> list[Verified[Any]]:
        return [one for one in ORDERS if self.model.states.get(order_id(one)) in names]

    @rule(order=WHICH)
    def arrives(self, order: Verified[Any]) -> None:
        self.orders.add(order, head=self.head)
        self.model.add(order)

    @rule(order=WHICH)
    def arrives_unfunded(self, order: Verified[Any]) -> None:
        self.orders.set_aside(order, now=0.0, head=self.head)
        if order_id(order) not in self.model.withdrawn:
            self.model.states.setdefault(order_id(order), "unfunded")

    @precondition(lambda self: self.in_state("unfunded"))
    @rule(is_funded=st.booleans())
    def its_maker_is_asked_after(self, is_funded: bool) -> None:
        due = self.orders.to_look_at(1e9, 9)
        assert {one.identity for one in due} == {order_id(one) for one in self.in_state("unfunded")}
        for record in due:
            if (order := self.orders.looked_at(record, is_funded=is_funded, now=0.0)) is not None:
                self.orders.add(order, head=self.head)
                self.model.add(order)

    @rule(order=WHICH)
    def is_withdrawn(self, order: Verified[Any]) -> None:
        self.model.withdrawn.add(order_id(order))
        self.orders.book.remove(order_id(order), OrderStage.WITHDRAWN)
        if order in self.in_state("open", "unfunded"):
            self.model.leave(order_id(order))

    @precondition(lambda self: self.in_state("matched"))
    @rule(data=st.data())
    def is_sent(self, data: st.DataObject) -> None:
        order = data.draw(st.sampled_from(self.in_state("matched")))
        self.orders.sending(order)
        self.model.states[order_id(order)] = "sending"

    @precondition(lambda self: self.in_state("matched", "sending", "mined"))
    @rule(data=st.data(), again=st.booleans())
    def its_sender_ends(self, data: st.DataObject, again: bool) -> None:
        order = data.draw(st.sampled_from(self.in_state("matched", "sending", "mined")))
        was_used = self.model.states[order_id(order)] == "mined"
        assert self.orders.end(order) is was_used
        self.orders.versions.ended([order], self.head)
        if was_used:
            self.model.states[order_id(order)] = "confirmed"
        else:
            self.model.leave(order_id(order))
            if again:
                self.arrives(order)

    @rule(order=WHICH, contract=st.sampled_from([CONTRACT, OTHER]))
    def becomes_a_contract(self, order: Verified[Any], contract: str) -> None:
        self.head += 1
        self.orders.created(contract, self.head, order_id(order))
        if (state := self.model.states.get(order_id(order))) is not None:
            self.model.leave(order_id(order))
            is_sent = state in ("matched", "sending", "mined")
            self.model.states[order_id(order)] = "mined" if is_sent else "confirmed"
            self.model.used[order_id(order)] = contract, self.head

    @rule(contract=st.sampled_from([CONTRACT, OTHER]))
    def is_reverted(self, contract: str) -> None:
        again = self.orders.reverted(contract, Demand, Offer)
        used = [one for one in ORDERS if self.model.used.get(order_id(one), ("",))[0] == contract]
        assert set(again) == set(used) & set(self.in_state("confirmed"))
        for order in used:
            is_waited_for = order in self.in_state("mined")
            self.model.leave(order_id(order))
            if is_waited_for:
                self.model.states[order_id(order)] = "sending"

    @rule(blocks=st.integers(0, 2 * DEPTH))
    def blocks_pass(self, blocks: int) -> None:
        self.head += blocks
        self.orders.confirm(self.head)
        for order in self.in_state("confirmed"):
            if self.model.used[order_id(order)][1] + DEPTH <= self.head:
                self.model.leave(order_id(order))

    @invariant()
    def they_agree(self) -> None:
        assert dict(zip(map(order_id, ORDERS), states(self.orders, *ORDERS), strict=True)) == {
            order_id(one): self.model.states.get(order_id(one)) for one in ORDERS
        }
        assert len(self.orders.book) == len(self.in_state("open", "unfunded"))
        assert [one for one in self.orders.book.orders() if one in self.in_state("open")] == self.model.queue
        assert self.orders.book.unfunded == len(self.in_state("unfunded"))


TestOrdersAgainstTheirModel = OrdersAgainstTheirModel.TestCase

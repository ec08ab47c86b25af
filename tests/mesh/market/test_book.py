"""The order book, each rule by itself."""

from __future__ import annotations

import sys
import tracemalloc
from typing import Any

import pytest

from mesh.market import Added, Match, OrderBook, order_id
from schemas import Demand, Verified, verify_message
from schemas.signing import Refusal
from tests.support.orders import (
    LIGHTHOUSE,
    OTHER_MODEL,
    PERSON,
    ROBOT,
    STRANGER,
    TOKEN,
    terms,
    verified_demand,
    verified_offer,
)


def book(*orders: Verified[Any], limit: int = 100) -> OrderBook:
    """A book with these orders open."""
    filled = OrderBook(LIGHTHOUSE, limit=limit)
    for order in orders:
        assert filled.add(order) == Added(order)
    return filled


def test_a_demand_and_an_offer_with_equal_terms_match_in_either_order() -> None:
    demand, offer = verified_demand(), verified_offer()

    assert book(demand).add(offer) == Match(demand, offer)
    assert book(offer).add(demand) == Match(demand, offer)


def test_matched_orders_leave_the_book() -> None:
    demand, offer = verified_demand(), verified_offer()
    matched = book(demand)
    matched.add(offer)

    assert len(matched) == 0
    assert order_id(demand) not in matched
    assert order_id(offer) not in matched
    assert list(matched.orders()) == []


@pytest.mark.parametrize(
    "difference",
    [
        {"model": OTHER_MODEL},
        {"objective": OTHER_MODEL},
        {"token": LIGHTHOUSE},
        {"cost": 43},
        {"validator": TOKEN},
        {"sender": ROBOT.address, "nonce": 1},
    ],
    ids=lambda difference: next(iter(difference)),
)
def test_orders_that_differ_in_a_term_do_not_match(difference: dict[str, Any]) -> None:
    offer = verified_offer(**difference)

    assert book(verified_demand()).add(offer) == Added(offer)


def test_fees_deadlines_and_nonces_may_differ() -> None:
    demand, offer = verified_demand(validator_fee=1, deadline=5), verified_offer(lighthouse_fee=2, deadline=6)

    assert book(demand).add(offer) == Match(demand, offer)


def test_orders_of_generation_5_match_among_themselves() -> None:
    demand = verified_demand(sender=PERSON.address, nonce=4)
    offer = verified_offer(sender=ROBOT.address, nonce=9)

    assert book(demand).add(offer) == Match(demand, offer)


def test_the_oldest_order_is_matched_first() -> None:
    offers = [verified_offer() for _ in range(3)]
    waiting = book(*offers)

    matched = [waiting.add(verified_demand()) for _ in range(3)]

    assert [match.offer for match in matched if isinstance(match, Match)] == offers


def test_an_order_removed_from_the_middle_is_not_matched() -> None:
    offers = [verified_offer() for _ in range(3)]
    waiting = book(*offers)
    assert waiting.remove(order_id(offers[1])) == offers[1]

    matched = [waiting.add(verified_demand()) for _ in range(3)]

    assert [match.offer for match in matched if isinstance(match, Match)] == [offers[0], offers[2]]
    assert isinstance(matched[2], Added)


def test_an_order_that_was_put_back_waits_at_the_end() -> None:
    offers = [verified_offer() for _ in range(2)]
    waiting = book(*offers)
    waiting.remove(order_id(offers[0]))
    waiting.add(offers[0])

    match = waiting.add(verified_demand())

    assert isinstance(match, Match)
    assert match.offer == offers[1]


def test_removing_an_order_that_is_not_open_returns_none() -> None:
    demand = verified_demand()
    emptied = book(demand)

    assert emptied.remove(order_id(demand)) == demand
    assert emptied.remove(order_id(demand)) is None
    assert emptied.remove(order_id(verified_demand())) is None


def test_an_order_of_another_lighthouse_is_refused() -> None:
    assert book().add(verified_demand(lighthouse=TOKEN)) is Refusal.LIGHTHOUSE


def test_an_order_whose_deadline_has_passed_is_refused() -> None:
    late = book()
    late.expire(10)

    assert late.add(verified_demand(deadline=10)) is Refusal.EXPIRED
    assert isinstance(late.add(verified_demand(deadline=11)), Added)


def test_an_open_order_is_refused_a_second_time() -> None:
    demand = verified_demand()

    assert book(demand).add(demand) is Refusal.DUPLICATE


def test_an_order_that_left_can_be_added_again() -> None:
    demand = verified_demand()
    again = book(demand)
    again.remove(order_id(demand))

    assert again.add(demand) == Added(demand)


def test_a_full_book_refuses_orders_but_still_matches() -> None:
    demand, offer = verified_demand(), verified_offer()
    full = book(demand, limit=1)

    assert full.add(verified_demand()) is Refusal.FULL
    assert full.add(offer) == Match(demand, offer)
    assert isinstance(full.add(verified_demand()), Added)


def test_equal_terms_signed_by_two_people_are_two_orders() -> None:
    same = terms()
    first, second = (verify_message(signer.sign(Demand(**same, validator_fee=0))) for signer in (PERSON, STRANGER))
    assert first.hash == second.hash
    both = book(first, second)

    assert both.remove(order_id(first)) == first
    assert (order_id(first) in both, order_id(second) in both) == (False, True)
    assert both.add(first) == Added(first)
    assert list(both.orders()) == [second, first]
    assert both.remove(order_id(second)) == second
    assert list(both.orders()) == [first]


def test_equal_orders_of_two_people_both_expire() -> None:
    same = terms(deadline=5)
    pair = [verify_message(signer.sign(Demand(**same, validator_fee=0))) for signer in (PERSON, STRANGER)]

    assert book(*pair).expire(5) == pair


def test_orders_expire_in_the_order_of_their_deadlines() -> None:
    orders = [verified_demand(deadline=deadline) for deadline in (7, 5, 6, 5)]
    aging = book(*orders)

    assert aging.expire(4) == []
    assert aging.expire(6) == [orders[1], orders[3], orders[2]]
    assert (aging.head, len(aging), list(aging.orders())) == (6, 1, [orders[0]])


def test_an_expired_order_is_not_matched() -> None:
    aging = book(verified_offer(deadline=5))
    aging.expire(5)

    assert isinstance(aging.add(verified_demand()), Added)


@pytest.mark.parametrize("head", [10**9, 2**256])
def test_a_head_far_ahead_takes_no_more_time_than_the_expired_orders(head: int) -> None:
    orders = [verified_demand(deadline=2**255), verified_demand(deadline=2**256 - 1), verified_demand(deadline=10**8)]

    assert set(map(order_id, book(*orders).expire(head))) >= {order_id(orders[2])}


def test_a_lower_head_changes_nothing() -> None:
    orders = [verified_demand(deadline=20), verified_demand(deadline=21)]
    reorganised = book(*orders)
    assert reorganised.expire(20) == [orders[0]]

    assert reorganised.expire(3) == []
    assert reorganised.head == 20
    assert reorganised.add(verified_demand(deadline=20)) is Refusal.EXPIRED
    assert reorganised.expire(20) == []
    assert reorganised.expire(21) == [orders[1]]


def test_an_order_that_left_before_its_deadline_does_not_expire() -> None:
    demand = verified_demand(deadline=5)
    aging = book(demand, verified_demand(deadline=5))
    aging.remove(order_id(demand))

    assert demand not in aging.expire(5)


def test_an_order_that_was_removed_and_added_again_expires_once() -> None:
    demand = verified_demand(deadline=5)
    aging = book(demand)
    aging.remove(order_id(demand))
    aging.add(demand)

    assert aging.expire(5) == [demand]
    assert len(aging) == 0


@pytest.mark.parametrize("how", ["removed", "matched", "expired"])
def test_the_book_holds_no_reference_to_an_order_that_left(how: str) -> None:
    kept = book(verified_demand(cost=1), verified_demand(cost=1))
    gone = verified_demand(deadline=5)
    message = gone.message
    before = sys.getrefcount(message)
    kept.add(gone)
    assert sys.getrefcount(message) > before

    match how:
        case "removed":
            kept.remove(order_id(gone))
        case "matched":
            kept.add(verified_offer())
        case "expired":
            kept.expire(5)

    assert sys.getrefcount(message) == before


def test_memory_is_bounded_for_orders_with_any_deadlines() -> None:
    pairs = [
        (verified_demand(cost=number, deadline=2**256 - 1 - number), verified_offer(cost=number, deadline=2**255))
        for number in range(500)
    ]
    through = book()

    def all_through() -> None:
        for demand, offer in pairs:
            through.add(demand)
            assert isinstance(through.add(offer), Match)

    all_through()
    tracemalloc.start()
    try:
        for _ in range(20):
            all_through()
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert grown < 30 * len(pairs)

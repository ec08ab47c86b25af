"""The messages under settlement."""

from __future__ import annotations

from mesh.market.book import order_id
from mesh.market.unconfirmed import Unconfirmed
from schemas import Demand, Offer, Result, verify_message
from tests.support.orders import CONTRACT, result, verified_demand, verified_offer

DEPTH = 3
OTHER = "0x27023154114b066515Ae678cb06E19417B8fcA73"


def test_a_message_without_an_event_leaves_when_its_transaction_ends() -> None:
    unconfirmed, demand = Unconfirmed(DEPTH), verified_demand()
    unconfirmed.begin(demand)
    assert demand in unconfirmed
    assert unconfirmed.get(order_id(demand)) == demand
    assert not unconfirmed.is_read(demand, until=100)
    assert not unconfirmed.end(demand)
    assert demand not in unconfirmed


def test_used_messages_stay_until_their_event_is_deep() -> None:
    unconfirmed, demand, offer = Unconfirmed(DEPTH), verified_demand(), verified_offer()
    unconfirmed.begin(demand)
    unconfirmed.created(CONTRACT, 10, demand, offer)
    assert (unconfirmed.is_read(demand, until=9), unconfirmed.is_read(demand, until=10)) == (False, True)
    assert unconfirmed.end(demand)
    unconfirmed.confirm(12)
    assert (demand in unconfirmed, offer in unconfirmed) == (True, True)
    unconfirmed.confirm(13)
    assert (demand in unconfirmed, offer in unconfirmed) == (False, False)
    assert unconfirmed.reverted(CONTRACT, Demand, Offer) == []


def test_a_message_whose_transaction_waits_does_not_leave() -> None:
    unconfirmed, ended = Unconfirmed(DEPTH), verify_message(result(liability=CONTRACT))
    unconfirmed.begin(ended)
    unconfirmed.finalized(CONTRACT, 10)
    unconfirmed.confirm(100)
    assert unconfirmed.is_read(ended, until=10)
    assert unconfirmed.reverted(CONTRACT, Result) == []
    assert not unconfirmed.is_read(ended, until=100)
    unconfirmed.finalized(CONTRACT, 11)
    assert unconfirmed.end(ended)
    unconfirmed.confirm(14)
    assert ended not in unconfirmed


def test_reverted_messages_are_returned_once_and_by_kind() -> None:
    unconfirmed, demand, ended = Unconfirmed(DEPTH), verified_demand(), verify_message(result(liability=CONTRACT))
    unconfirmed.begin(ended)
    unconfirmed.created(CONTRACT, 10, demand)
    unconfirmed.finalized(CONTRACT, 11)
    unconfirmed.end(ended)
    assert unconfirmed.reverted(OTHER, Demand, Result) == []
    assert unconfirmed.reverted(CONTRACT, Result) == [ended]
    assert unconfirmed.reverted(CONTRACT, Demand, Offer) == [demand]
    assert unconfirmed.reverted(CONTRACT, Demand, Offer, Result) == []


def test_an_order_that_another_contract_uses_after_a_reorganisation_belongs_to_that_one() -> None:
    unconfirmed, demand = Unconfirmed(DEPTH), verified_demand()
    unconfirmed.begin(demand)
    unconfirmed.created(CONTRACT, 10, demand)
    unconfirmed.reverted(CONTRACT, Demand)
    unconfirmed.created(OTHER, 11, demand)
    unconfirmed.end(demand)
    assert unconfirmed.reverted(CONTRACT, Demand) == []
    assert unconfirmed.reverted(OTHER, Demand) == [demand]


def test_the_number_of_used_messages_is_bounded() -> None:
    unconfirmed, demands = Unconfirmed(DEPTH, limit=2), [verified_demand() for _ in range(3)]
    for demand in demands:
        unconfirmed.created(CONTRACT, 10, demand)
    unconfirmed.confirm(10)
    assert [demand in unconfirmed for demand in demands] == [False, True, True]

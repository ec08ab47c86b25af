"""The messages that are kept for a reorganisation."""

from __future__ import annotations

from mesh.market.settlement import SettledMessages
from schemas import Demand, Offer, Result, verify_message
from tests.support.orders import result, verified_demand, verified_offer


def test_messages_are_popped_by_kind_and_once() -> None:
    demand, offer, ended = verified_demand(), verified_offer(), verify_message(result())
    messages = SettledMessages()
    messages.add("a", demand, None, offer)
    messages.add("a", ended, demand)

    assert messages.pop("a", Demand, Offer) == [demand, offer]
    assert messages.pop("a", Demand, Offer) == []
    assert messages.pop("a", Result) == [ended]
    assert messages.pop("b", Result) == []


def test_the_oldest_liability_is_forgotten() -> None:
    messages = SettledMessages(limit=2)
    for name in "abc":
        messages.add(name, verified_demand())

    assert [len(messages.pop(name, Demand)) for name in "abc"] == [0, 1, 1]

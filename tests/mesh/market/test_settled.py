"""What became of messages: kept for the latest liabilities only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.market import settled
from mesh.market.settled import SettledMessages
from schemas import Demand, Offer, Result, verify_message
from tests.support.orders import result, verified_demand, verified_offer

if TYPE_CHECKING:
    import pytest


def test_messages_are_taken_out_by_kind_and_once() -> None:
    demand, offer, ended = verified_demand(), verified_offer(), verify_message(result())
    messages = SettledMessages()
    messages.add("a", demand, None, offer)
    messages.add("a", ended, demand)

    assert messages.pop("a", Demand, Offer) == [demand, offer]
    assert messages.pop("a", Demand, Offer) == []
    assert messages.pop("a", Result) == [ended]
    assert messages.pop("b", Result) == []


def test_the_oldest_liability_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(settled, "REMEMBERED", 2)
    messages = SettledMessages()
    for name in "abc":
        messages.add(name, verified_demand())

    assert [len(messages.pop(name, Demand)) for name in "abc"] == [0, 1, 1]

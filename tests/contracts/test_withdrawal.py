"""An order's maker makes it unusable, whatever a provider does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace
from web3.logs import DISCARD

from schemas import message_hash
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")


@pytest.mark.parametrize("withdrawn", ["demand", "offer"])
def test_a_withdrawn_order_makes_no_liability(market: Market, withdrawn: str) -> None:
    demand, offer = market.pair(cost=XRT)
    order, maker = (demand, market.promisee) if withdrawn == "demand" else (offer, market.promisor)

    market.suite.send(market.withdrawal(order), maker)

    refusal = market.refusal(market.creation(demand, offer))
    if market.generation == 3:
        assert refusal == ("OrderUsed", message_hash(order))
        assert market.suite.factory.functions.isOrderUsed(message_hash(order), maker.address).call()
    else:
        assert refusal[:2] == ("WrongSigner", maker.address)
    market.create(cost=XRT)


def test_an_order_that_has_made_its_liability_can_not_be_withdrawn(market: Market) -> None:
    demand, offer = market.pair(cost=XRT)
    market.suite.send(market.creation(demand, offer), market.provider)
    for order, maker in ((demand, market.promisee), (offer, market.promisor)):
        refusal = market.refusal(market.withdrawal(order), maker)
        if market.generation == 3:
            assert refusal == ("OrderUsed", message_hash(order))
        else:
            assert refusal == ("WrongNonce", int(order.nonce), int(order.nonce) + 1)


def test_an_order_is_withdrawn_once(market: Market) -> None:
    demand = market.demand()
    market.suite.send(market.withdrawal(demand), market.promisee)
    refusal = market.refusal(market.withdrawal(demand), market.promisee)
    assert refusal[0] == {3: "OrderUsed", 5: "WrongNonce"}[market.generation]


@pytest.mark.parametrize("first", ["stranger", "maker"])
def test_a_stranger_withdraws_only_for_itself(third: Market, first: str) -> None:
    suite = third.suite
    demand, offer = third.pair(cost=XRT)
    call = third.withdrawal(demand)
    callers = [third.outsider, third.promisee]
    if first == "stranger":
        suite.send(call, callers[0])
        third.suite.send(third.creation(demand, offer), third.provider)
        assert third.refusal(call, third.promisee) == ("OrderUsed", message_hash(demand))
        return
    for caller in reversed(callers):
        suite.send(call, caller)
    copied = third.outsider.signer.sign(replace(demand, signature=""))
    for order in (demand, copied):
        assert third.refusal(third.creation(order, offer)) == ("OrderUsed", message_hash(demand))


def test_a_nonce_ahead_is_not_withdrawn(fifth: Market) -> None:
    order = fifth.demand(ahead=1)
    refusal = fifth.refusal(fifth.withdrawal(order), fifth.promisee)
    assert refusal == ("WrongNonce", int(order.nonce), int(order.nonce) - 1)


def test_a_withdrawal_is_announced(market: Market) -> None:
    demand = market.demand()
    receipt = market.suite.send(market.withdrawal(demand), market.promisee)
    events = market.suite.factory.events
    maker = market.promisee.address
    if market.generation == 3:
        (event,) = events.OrderWithdrawn().process_receipt(receipt, errors=DISCARD)
        assert dict(event["args"]) == {"hash": message_hash(demand), "signer": maker}
    else:
        (event,) = events.NonceWithdrawn().process_receipt(receipt, errors=DISCARD)
        assert dict(event["args"]) == {"nonce": int(demand.nonce), "sender": maker}

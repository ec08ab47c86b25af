"""From a demand and an offer to the end of the liability, with the balances at each step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from web3.logs import DISCARD

from schemas import ZERO_ADDRESS, message_hash, parse_cid
from tests.support.contracts.market import MODEL, OBJECTIVE, RESULT
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from tests.support.contracts.market import Market

pytestmark = pytest.mark.sample("market")

COST = 5 * XRT
FEE = 2 * XRT
HUGE = 2**256 - 1


@pytest.mark.parametrize(("lighthouse_fee", "deadline"), [(0, 10**6), (FEE, HUGE)])
def test_liability_answers_the_terms_that_were_signed(market: Market, lighthouse_fee: int, deadline: int) -> None:
    demand = market.demand(cost=COST, deadline=deadline, validator_fee=1)
    offer = market.offer(cost=COST, lighthouse_fee=lighthouse_fee)
    receipt = market.suite.send(market.creation(demand, offer), market.provider)
    terms = market.liability_of(receipt).functions

    assert terms.model().call() == parse_cid(MODEL)
    assert terms.objective().call() == parse_cid(OBJECTIVE)
    assert terms.result().call() == b""
    assert terms.token().call() == market.suite.xrt.address
    assert terms.cost().call() == COST
    assert terms.lighthouseFee().call() == lighthouse_fee
    assert terms.validatorFee().call() == 1
    assert terms.demandHash().call() == message_hash(demand)
    assert terms.offerHash().call() == message_hash(offer)
    assert terms.promisee().call() == market.promisee.address
    assert terms.promisor().call() == market.promisor.address
    assert terms.lighthouse().call() == market.lighthouse.address
    assert terms.validator().call() == ZERO_ADDRESS
    assert terms.generation().call() == market.generation
    assert terms.createdAt().call() == receipt["blockNumber"]
    assert terms.refundableFrom().call() == receipt["blockNumber"] + REFUND_DELAY
    assert not terms.isFinalized().call()
    assert not terms.isSuccess().call()


def test_the_largest_terms_are_kept_to_the_last_bit(market: Market) -> None:
    suite = market.suite
    token = suite.deploy("SilentToken", HUGE)
    suite.send(token.functions.transfer(market.promisee.address, HUGE))
    validator = suite.deploy("OneSigner", market.promisor.address)
    shared: dict[str, Any] = {"token": token.address, "cost": HUGE, "validator": validator.address}
    demand = market.demand(validator_fee=FEE, deadline=HUGE, **shared)
    offer = market.offer(lighthouse_fee=FEE - 1, deadline=HUGE - 1, **shared)
    terms = market.liability_of(suite.send(market.creation(demand, offer), market.provider)).functions

    assert (terms.token().call(), terms.cost().call()) == (token.address, HUGE)
    assert (terms.validatorFee().call(), terms.lighthouseFee().call()) == (FEE, FEE - 1)
    assert terms.validator().call() == validator.address
    assert (terms.demandHash().call(), terms.offerHash().call()) == (message_hash(demand), message_hash(offer))


def test_creation_is_announced_by_the_factory(market: Market) -> None:
    demand, offer = market.pair()
    receipt = market.suite.send(market.creation(demand, offer), market.provider)
    liability = market.liability_of(receipt)

    consumed = market.suite.factory.events.HashConsumed().process_receipt(receipt, errors=DISCARD)
    assert [event["args"]["hash"] for event in consumed] == [message_hash(demand), message_hash(offer)]
    assert market.suite.factory.functions.isLiability(liability.address).call()
    assert not market.suite.factory.functions.isLighthouse(liability.address).call()


def test_success_pays_the_promisor(market: Market) -> None:
    suite = market.suite
    liability = market.create(cost=COST)
    assert suite.balance(suite.factory) == COST
    before = suite.balance(market.promisee), suite.balance(market.promisor)

    market.finalize(liability, success=True)

    assert (suite.balance(market.promisee), suite.balance(market.promisor)) == (before[0], before[1] + COST)
    assert suite.balance(suite.factory) == 0


def test_failure_gives_the_cost_back_to_the_promisee(market: Market) -> None:
    suite = market.suite
    before = suite.balance(market.promisee), suite.balance(market.promisor)
    liability = market.create(cost=COST)

    market.finalize(liability, success=False)

    assert (suite.balance(market.promisee), suite.balance(market.promisor)) == before
    assert suite.balance(suite.factory) == 0


@pytest.mark.parametrize("success", [True, False])
def test_the_end_is_on_the_liability_and_announced_by_it(market: Market, success: bool) -> None:
    liability = market.create()
    receipt = market.finalize(liability, success=success)

    assert liability.functions.isFinalized().call()
    assert liability.functions.isSuccess().call() == success
    assert liability.functions.result().call() == parse_cid(RESULT)
    (event,) = liability.events.Finalized().process_receipt(receipt, errors=DISCARD)
    assert event["address"] == liability.address
    assert dict(event["args"]) == {"success": success, "result": parse_cid(RESULT)}


def test_lighthouse_fee_goes_from_the_promisor_to_the_provider_at_creation(market: Market) -> None:
    suite = market.suite
    before = suite.balance(market.promisor), suite.balance(market.provider)
    market.create(lighthouse_fee=FEE)
    assert (suite.balance(market.promisor), suite.balance(market.provider)) == (before[0] - FEE, before[1] + FEE)


def test_validator_fee_is_not_taken_without_a_validator(market: Market) -> None:
    before = market.suite.balance(market.promisee)
    market.create(validator_fee=FEE)
    assert market.suite.balance(market.promisee) == before


def test_one_account_may_be_promisee_and_promisor(market: Market) -> None:
    both = market.promisee
    orders = market.demand(cost=COST), market.offer(by=both, ahead=1, cost=COST)
    liability = market.liability_of(market.suite.send(market.creation(*orders), market.provider))

    market.suite.send(market.finalization(market.result(liability, by=both)), market.provider)

    assert liability.functions.offerHash().call() == message_hash(orders[1])
    assert liability.functions.isSuccess().call()


def test_the_other_generations_call_ends_a_liability_too(market: Market) -> None:
    liability = market.create(cost=COST)
    market.generation = 8 - market.generation
    try:
        market.finalize(liability)
    finally:
        market.generation = 8 - market.generation
    assert liability.functions.isSuccess().call()


def test_the_promisee_is_refunded_when_the_promisor_stays_silent(market: Market) -> None:
    suite = market.suite
    before = suite.balance(market.promisee)
    liability = market.create(cost=COST)
    suite.chain.mine(REFUND_DELAY - 1)

    receipt = suite.send(suite.factory.functions.refund(liability.address), market.outsider)

    assert suite.balance(market.promisee) == before
    assert liability.functions.isFinalized().call()
    assert not liability.functions.isSuccess().call()
    assert liability.functions.result().call() == b""
    (event,) = liability.events.Finalized().process_receipt(receipt, errors=DISCARD)
    assert dict(event["args"]) == {"success": False, "result": b""}


def test_a_late_result_counts_until_the_refund(market: Market) -> None:
    liability = market.create(cost=COST)
    market.suite.chain.mine(REFUND_DELAY + 5)
    market.finalize(liability)
    assert market.refusal(market.suite.factory.functions.refund(liability.address)) == (
        "AlreadyFinalized",
        liability.address,
    )


def test_liabilities_do_not_touch_each_others_money(market: Market) -> None:
    suite = market.suite
    first, second = market.create(cost=COST), market.create(cost=3 * COST)
    market.finalize(first, success=False)
    assert suite.balance(suite.factory) == 3 * COST
    market.finalize(second)
    assert suite.balance(suite.factory) == 0

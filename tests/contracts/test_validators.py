"""Liabilities that a third party judges."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import pytest
from msgspec.structs import force_setattr, replace

from schemas import Demand, Offer, message_hash, order_abi, parse_cid
from tests.support.contracts.market import RESULT
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from web3.contract import Contract
    from web3.types import TxReceipt

    from tests.support.contracts.market import Market
    from tests.support.contracts.suite import Person

AnOrder = TypeVar("AnOrder", Demand, Offer)

pytestmark = pytest.mark.sample("market")

COST = 5 * XRT
FEE = XRT


def judge(market: Market, liability: Contract, *, success: bool, agree: bool) -> TxReceipt:
    """The outsider, as the validator, says what it thinks of the promisor's result."""
    signature = bytes.fromhex(market.result(liability, success=success).signature)
    verdict = liability.functions.finalize(parse_cid(RESULT), success, signature, agree)
    return market.suite.send(verdict, market.outsider)


@pytest.mark.parametrize(("success", "agree"), [(True, True), (True, False), (False, True), (False, False)])
def test_in_generation_3_the_promisor_is_paid_when_result_and_validator_agree(
    third: Market, success: bool, agree: bool
) -> None:
    suite = third.suite
    liability = third.create(cost=COST, validator=third.outsider.address, validator_fee=FEE)
    before = [suite.balance(person) for person in (third.promisee, third.promisor, third.outsider)]

    judge(third, liability, success=success, agree=agree)

    paid = COST if success and agree else 0
    after = [suite.balance(person) for person in (third.promisee, third.promisor, third.outsider)]
    assert [now - then for now, then in zip(after, before, strict=True)] == [COST - paid, paid, FEE]
    assert liability.functions.isSuccess().call() == (success and agree)
    assert liability.functions.result().call() == parse_cid(RESULT)


def test_in_generation_3_only_the_validator_ends_a_judged_liability(third: Market) -> None:
    liability = third.create(cost=COST, validator=third.outsider.address)
    result = third.result(liability)
    assert third.refusal(third.finalization(result)) == ("NotTheValidator", third.provider.address)
    signature = bytes.fromhex(result.signature)
    verdict = liability.functions.finalize(parse_cid(RESULT), True, signature, True)
    for person in (third.promisor, third.promisee, third.provider):
        assert third.refusal(verdict, person) == ("NotTheValidator", person.address)


def test_in_generation_3_the_validator_cannot_alter_the_result(third: Market) -> None:
    liability = third.create(cost=COST, validator=third.outsider.address)
    own = bytes.fromhex(third.result(liability, by=third.outsider).signature)
    verdict = liability.functions.finalize(parse_cid(RESULT), True, own, True)
    assert third.refusal(verdict, third.outsider) == ("WrongSigner", third.promisor.address, third.outsider.address)


def test_in_generation_3_a_liability_is_judged_once(third: Market) -> None:
    liability = third.create(cost=COST, validator=third.outsider.address)
    judge(third, liability, success=True, agree=True)
    signature = bytes.fromhex(third.result(liability).signature)
    verdict = liability.functions.finalize(parse_cid(RESULT), True, signature, True)
    assert third.refusal(verdict, third.outsider) == ("AlreadyFinalized", liability.address)


def test_in_generation_5_the_validator_contract_decides_which_result_counts(fifth: Market) -> None:
    suite = fifth.suite
    validator = suite.deploy("OneSigner", fifth.outsider.address)
    liability = fifth.create(cost=COST, validator=validator.address, validator_fee=FEE)
    before = suite.balance(fifth.promisor)

    refused = fifth.finalization(fifth.result(liability))
    assert fifth.refusal(refused) == ("RefusedByValidator", fifth.promisor.address)
    suite.send(fifth.finalization(fifth.result(liability, by=fifth.outsider)), fifth.provider)

    assert suite.balance(fifth.promisor) == before + COST
    assert suite.balance(validator) == FEE
    assert validator.functions.lastAsker().call() == liability.address


def test_in_generation_5_an_account_cannot_be_validator(fifth: Market) -> None:
    call = fifth.creation(*fifth.pair(validator=fifth.outsider.address))
    assert fifth.refusal(call) == ("ValidatorWithoutCode", fifth.outsider.address)


def test_a_validator_that_does_not_answer_locks_nothing(market: Market) -> None:
    suite = market.suite
    validator = suite.deploy("BrokenValidator")
    before = suite.balance(market.promisee)
    liability = market.create(cost=COST, validator=validator.address, validator_fee=FEE)
    assert market.refusal(market.finalization(market.result(liability)))
    suite.chain.mine(REFUND_DELAY)

    suite.send(suite.factory.functions.refund(liability.address))

    assert suite.balance(market.promisee) == before
    assert suite.balance(suite.factory) == 0


def judged_by(order: AnOrder, person: Person, validator: str) -> AnOrder:
    """The order with that validator, signed again; our own messages refuse their lighthouse as validator."""
    order = replace(order)
    force_setattr(order, "validator", validator)
    force_setattr(order, "signature", person.signer.sign_hash(message_hash(order)).hex())
    return order


@pytest.mark.parametrize("own", [False, True], ids=["the same lighthouse", "a lighthouse of the thief"])
def test_an_offer_is_not_taken_for_a_demand_of_the_robot(market: Market, own: bool) -> None:
    """An offer on lighthouse L with validator V has the bytes of a demand on lighthouse V with validator L."""
    suite, robot, thief = market.suite, market.promisor, market.outsider
    trap = market.lighthouse
    if own:
        trap = suite.create_lighthouse(name="trap")
    suite.join(trap, thief, XRT)
    before = suite.balance(robot)
    as_demand = order_abi(judged_by(market.offer(cost=COST), robot, trap.address))
    counter = judged_by(market.offer(by=thief, cost=COST, lighthouse=trap.address), thief, market.lighthouse.address)
    while not trap.functions.isTurnOf(thief.address).call():
        suite.chain.mine(1)

    theft = market.creation(as_demand, counter, trap)

    suite.attempt(theft, thief)
    assert suite.balance(robot) == before
    assert market.refusal(theft, thief) == ("ValidatorIsLighthouse", market.lighthouse.address)


def test_no_order_names_a_lighthouse_as_validator(market: Market) -> None:
    other = market.suite.create_lighthouse(name="other")
    for lighthouse in (market.lighthouse, other):
        demand = judged_by(market.demand(cost=COST), market.promisee, lighthouse.address)
        offer = judged_by(market.offer(cost=COST), market.promisor, lighthouse.address)
        assert market.refusal(market.creation(demand, offer)) == ("ValidatorIsLighthouse", lighthouse.address)

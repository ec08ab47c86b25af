"""Promisee and promisor agree to end a liability before there is a result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from web3.logs import DISCARD

from schemas import address_bytes, keccak256
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from collections.abc import Callable

    from web3.contract import Contract

    from tests.support.contracts.market import Market
    from tests.support.contracts.suite import Person

pytestmark = pytest.mark.sample("market")

COST = 5 * XRT
FEE = XRT


@pytest.fixture
def liability(market: Market) -> Contract:
    """A liability that costs something."""
    return market.create(cost=COST)


def signed(person: Person, liability: Contract, word: bytes = b"cancel") -> bytes:
    """An account's signature under the cancellation of a liability, or under another word."""
    return person.signer.sign_hash(keccak256(address_bytes(liability.address) + word))


def cancellation(market: Market, liability: Contract) -> Any:
    """The call that cancels, with both parties' signatures."""
    signatures = (signed(person, liability) for person in (market.promisee, market.promisor))
    return market.suite.factory.functions.cancel(liability.address, *signatures)


def test_the_promisee_has_the_cost_back_at_once(market: Market) -> None:
    suite = market.suite
    before = suite.balance(market.promisee), suite.balance(market.promisor)
    liability = market.create(cost=COST)

    receipt = suite.send(cancellation(market, liability), market.outsider)

    assert (suite.balance(market.promisee), suite.balance(market.promisor)) == before
    assert suite.balance(suite.factory) == 0
    assert liability.functions.isFinalized().call()
    assert not liability.functions.isSuccess().call()
    assert liability.functions.result().call() == b""
    (event,) = liability.events.Finalized().process_receipt(receipt, errors=DISCARD)
    assert dict(event["args"]) == {"success": False, "result": b""}


def test_the_validator_who_was_not_asked_is_not_paid(market: Market) -> None:
    suite = market.suite
    before = suite.balance(market.promisee)
    jury = suite.deploy("Jury", suite.xrt.address, [market.outsider.address], 1)
    liability = market.create(cost=COST, validator=jury.address, validator_fee=FEE)

    suite.send(cancellation(market, liability))

    assert suite.balance(market.promisee) == before
    assert suite.balance(jury) == 0


def test_cancellation_needs_both_parties(market: Market, liability: Contract) -> None:
    cancel = market.suite.factory.functions.cancel
    promisee, promisor = signed(market.promisee, liability), signed(market.promisor, liability)
    other = signed(market.outsider, liability)
    first, second = market.promisee.address, market.promisor.address
    for signatures, refusal in (
        ((other, promisor), ("WrongSigner", first, market.outsider.address)),
        ((promisee, other), ("WrongSigner", second, market.outsider.address)),
        ((promisee, promisee), ("WrongSigner", second, first)),
        ((promisor, promisee), ("WrongSigner", first, second)),
        ((promisee, b""), ("InvalidSignature",)),
        ((promisee, promisor), ()),
    ):
        assert market.refusal(cancel(liability.address, *signatures)) == refusal


def test_a_signature_is_for_its_liability_and_its_word_alone(market: Market, liability: Contract) -> None:
    cancel = market.suite.factory.functions.cancel
    other = market.create(cost=COST)
    agreed = signed(market.promisor, liability)
    for wrong in (signed(market.promisee, other), signed(market.promisee, liability, b"refund")):
        assert market.refusal(cancel(liability.address, wrong, agreed))[0] == "WrongSigner"


def test_no_result_and_no_order_can_be_taken_for_a_cancellation(market: Market, liability: Contract) -> None:
    result = bytes.fromhex(market.result(liability).signature)
    cancel = market.suite.factory.functions.cancel(liability.address, signed(market.promisee, liability), result)
    assert market.refusal(cancel)[0] == "WrongSigner"


def finalization(market: Market, liability: Contract) -> Any:
    """The call of the market's provider."""
    return market.finalization(market.result(liability))


def refund(market: Market, liability: Contract) -> Any:
    """The call of anybody."""
    return market.suite.factory.functions.refund(liability.address)


ENDS = (finalization, refund, cancellation)


@pytest.mark.parametrize("second", ENDS)
@pytest.mark.parametrize("first", ENDS)
def test_result_refund_and_cancellation_exclude_each_other(
    market: Market,
    liability: Contract,
    first: Callable[[Market, Contract], Any],
    second: Callable[[Market, Contract], Any],
) -> None:
    market.suite.chain.mine(REFUND_DELAY)
    market.suite.send(first(market, liability), market.provider)
    assert market.refusal(second(market, liability)) == ("AlreadyFinalized", liability.address)


def test_only_liabilities_of_the_factory_can_be_cancelled(market: Market) -> None:
    somebody = market.lighthouse
    assert market.refusal(cancellation(market, somebody)) == ("NotALiability", somebody.address)


def test_a_cancellation_mints_nothing_and_counts_the_gas(market: Market, liability: Contract) -> None:
    suite = market.suite
    supply = suite.xrt.functions.totalSupply().call()
    suite.send(cancellation(market, liability))
    assert suite.xrt.functions.totalSupply().call() == supply
    assert suite.factory.functions.totalGasConsumed().call() > 0
    assert suite.factory.functions.gasConsumedOf(liability.address).call() > 0

"""What providers are paid for gas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tests.support.contracts.market import Market
from tests.support.contracts.suite import REFUND_DELAY, XRT, Suite

if TYPE_CHECKING:
    from tests.support.contracts.chains import Chain

pytestmark = pytest.mark.sample("market")

COST = 5 * XRT


def minted(market: Market, before: int) -> int:
    """wn that there are more than before."""
    return int(market.suite.xrt.functions.totalSupply().call()) - before


def supply(market: Market) -> int:
    """All wn."""
    return int(market.suite.xrt.functions.totalSupply().call())


def test_the_provider_who_finalizes_is_paid_for_the_gas_of_a_paid_liability(market: Market) -> None:
    suite = market.suite
    liability = market.create(cost=COST)
    before, holding = supply(market), suite.balance(market.provider)
    market.finalize(liability)
    gas = suite.factory.functions.gasConsumedOf(liability.address).call()
    assert minted(market, before) == suite.factory.functions.wnFromGas(gas).call() > 0
    assert suite.balance(market.provider) == holding + minted(market, before)


@pytest.mark.parametrize("generation", [3, 5])
def test_whoever_deploys_says_what_gas_is_worth(chain: Chain, undone: None, generation: int) -> None:
    market = Market(Suite(chain, emission=256), generation)
    liability = market.create(cost=COST)
    before = supply(market)
    market.finalize(liability)
    gas = market.suite.factory.functions.gasConsumedOf(liability.address).call()
    assert minted(market, before) == gas * 256 // 100


def test_no_more_is_minted_than_was_paid(market: Market) -> None:
    liability = market.create(cost=7)
    before = supply(market)
    market.finalize(liability)
    assert minted(market, before) == 7


def test_zero_cost_earns_nothing(market: Market) -> None:
    liability = market.create(lighthouse_fee=XRT)
    before = supply(market)
    market.finalize(liability)
    assert minted(market, before) == 0


def test_failure_earns_nothing_as_no_money_changed_hands(market: Market) -> None:
    liability = market.create(cost=COST)
    before = supply(market)
    market.finalize(liability, success=False)
    assert minted(market, before) == 0


@pytest.mark.parametrize("dealer", ["promisee is promisor", "provider is promisee", "provider is promisor"])
def test_trading_with_oneself_earns_nothing(market: Market, dealer: str) -> None:
    suite = market.suite
    suite.fund(market.provider, COST, suite.factory.address)
    promisee, promisor = {
        "promisee is promisor": (market.promisee, market.promisee),
        "provider is promisee": (market.provider, market.promisor),
        "provider is promisor": (market.promisee, market.provider),
    }[dealer]
    ahead = 1 if promisee is promisor else 0
    orders = market.demand(by=promisee, cost=COST), market.offer(by=promisor, ahead=ahead, cost=COST)
    liability = market.liability_of(suite.send(market.creation(*orders), market.provider))
    before = supply(market)
    suite.send(market.finalization(market.result(liability, by=promisor)), market.provider)
    assert minted(market, before) == 0


def test_another_token_earns_nothing_as_anybody_can_make_one(market: Market) -> None:
    suite = market.suite
    token = suite.deploy("SilentToken", COST)
    suite.send(token.functions.transfer(market.promisee.address, COST))
    liability = market.create(token=token.address, cost=COST)
    before = supply(market)
    market.finalize(liability)
    assert minted(market, before) == 0


def test_gas_is_counted_once_at_the_end(market: Market) -> None:
    functions = market.suite.factory.functions
    liability = market.create(cost=COST)
    before = functions.totalGasConsumed().call()
    assert functions.gasConsumedOf(liability.address).call() == 0
    market.finalize(liability)
    gas = functions.gasConsumedOf(liability.address).call()
    assert functions.totalGasConsumed().call() == functions.totalGasUtilizing().call() == before + gas
    assert functions.gasUtilizing(liability.address).call() == gas
    assert functions.gasConsumedOf(market.outsider.address).call() == 0


def test_gas_of_a_refund_is_counted_but_not_paid(market: Market) -> None:
    suite = market.suite
    liability = market.create(cost=COST)
    suite.chain.mine(REFUND_DELAY)
    before, gas = supply(market), suite.factory.functions.totalGasConsumed().call()
    suite.send(suite.factory.functions.refund(liability.address), market.provider)
    counted = suite.factory.functions.gasConsumedOf(liability.address).call()
    assert (minted(market, before), suite.factory.functions.totalGasConsumed().call()) == (0, gas + counted)


@pytest.mark.parametrize("terms", [{}, {"cost": COST}, {"cost": COST, "lighthouse_fee": XRT}])
def test_the_gas_schedule_matches_the_gas_of_a_liability(market: Market, terms: dict[str, Any]) -> None:
    suite = market.suite
    # The first of everything pays for new storage; a liability that stays keeps the factory's balance above zero.
    market.finalize(market.create(**{"cost": COST, **terms}))
    market.create(cost=COST)
    created = suite.send(market.creation(*market.pair(**terms)), market.provider)
    liability = market.liability_of(created)
    ended = market.finalize(liability)
    taken = created["gasUsed"] + ended["gasUsed"]
    credited = suite.factory.functions.gasConsumedOf(liability.address).call()
    assert credited == pytest.approx(taken, rel=0.03)

"""Providers that hold the turn can't keep the promisor from its pay."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from web3.logs import DISCARD

from schemas import ZERO_ADDRESS
from tests.support.ci import IN_CI
from tests.support.contracts.books import Terms
from tests.support.contracts.market import Market
from tests.support.contracts.stage import FOREVER, Stage, Work
from tests.support.contracts.suite import REFUND_DELAY, XRT, Suite

if TYPE_CHECKING:
    from tests.support.contracts.chains import Chain
    from tests.support.contracts.suite import Person

pytestmark = pytest.mark.sample("market")

TIMEOUT: Final = 10
DELAY: Final = 120
COST: Final = 5 * XRT


@pytest.fixture(params=[3, 5])
def held(request: pytest.FixtureRequest, chain: Chain) -> Market:
    """A market with a refund delay of some timeouts, and a lighthouse with a rogue provider and an honest one."""
    market = Market(Suite(chain, refund_delay=DELAY), request.param)
    market.suite.join(market.lighthouse, honest(market), XRT)
    return market


def honest(market: Market) -> Person:
    """The provider that the rogue keeps from its turns."""
    return market.suite.people[5]


def hold_the_turn(market: Market, until: int) -> int:
    """The rogue sends free liabilities of its own just before each timeout; returns how many."""
    suite, sent = market.suite, 0
    while suite.web3.eth.block_number + TIMEOUT < until:
        suite.chain.mine(TIMEOUT - 1)
        filler = market.creation(market.demand(by=market.provider), market.offer(by=market.outsider))
        suite.send(filler, market.provider)
        sent += 1
    return sent


def test_a_provider_that_holds_the_turn_does_not_keep_the_promisor_from_its_pay(held: Market) -> None:
    suite = held.suite
    liability = held.create(cost=COST)
    refundable = liability.functions.refundableFrom().call()
    result = held.result(liability)
    before = suite.balance(held.promisor)

    assert hold_the_turn(held, refundable - 1) == 11
    assert held.refusal(held.finalization(result), honest(held))[0] == "NotYourTurn"
    receipt = suite.send(held.finalization_without_turn(result), held.promisor)

    assert receipt["blockNumber"] < refundable
    assert suite.balance(held.promisor) == before + COST
    suite.chain.mine(TIMEOUT)
    assert held.refusal(suite.factory.functions.refund(liability.address)) == ("AlreadyFinalized", liability.address)


@pytest.mark.parametrize("success", [True, False])
def test_anybody_brings_a_result_without_a_turn_and_mints_nothing(market: Market, success: bool) -> None:
    suite = market.suite
    liability = market.create(cost=COST)
    result = market.result(liability, success=success)
    supply, quota = suite.xrt.functions.totalSupply().call(), market.lighthouse.functions.quota().call()

    receipt = suite.send(market.finalization_without_turn(result), market.outsider)

    (event,) = liability.events.Finalized().process_receipt(receipt, errors=DISCARD)
    assert event["args"]["success"] == success
    assert liability.functions.isSuccess().call() == success
    assert (suite.xrt.functions.totalSupply().call(), market.lighthouse.functions.quota().call()) == (supply, quota)
    assert suite.factory.functions.gasConsumedOf(liability.address).call() > 0
    assert market.refusal(market.finalization_without_turn(result)) == ("AlreadyFinalized", liability.address)


def test_without_a_turn_only_the_promisors_result_counts(market: Market) -> None:
    liability = market.create(cost=COST)
    forged = market.finalization_without_turn(market.result(liability, by=market.promisee))
    assert market.refusal(forged) == ("WrongSigner", market.promisor.address, market.promisee.address)


def test_a_validator_is_asked_without_a_turn_too(market: Market) -> None:
    suite, judge = market.suite, market.outsider
    validator = suite.deploy("OneSigner", judge.address).address if market.generation == 5 else judge.address
    liability = market.create(cost=COST, validator=validator)
    bring = market.finalization_without_turn
    if market.generation == 3:
        assert market.refusal(bring(market.result(liability)), judge) == ("NotTheValidator", judge.address)
        return
    assert market.refusal(bring(market.result(liability))) == ("RefusedByValidator", market.promisor.address)
    suite.send(bring(market.result(liability, by=judge)), market.promisor)
    assert liability.functions.isSuccess().call()


@cache
def stage() -> Stage:
    """The contracts, deployed once."""
    return Stage()


CONSPIRATORS: Final = (0, 2, 3, 4)
"""All people but the promisor, which is honest: the promisee, two providers, and one more."""

ROGUE: Final = st.sampled_from(CONSPIRATORS)

ACTION: Final = st.one_of(
    st.tuples(st.just("fill"), ROGUE),
    st.tuples(st.just("forge"), ROGUE, ROGUE, st.booleans(), st.booleans()),
    st.tuples(st.just("finish"), ROGUE),
    st.tuples(st.just("refund"), ROGUE),
    st.tuples(st.just("cancel"), ROGUE),
    st.tuples(st.sampled_from(("refill", "withdraw")), ROGUE, st.sampled_from((0, 1, XRT, 3 * XRT))),
    st.tuples(st.just("approve"), ROGUE),
    st.tuples(st.just("wait"), st.sampled_from((1, 2, 5, 11))),
)


class Conspiracy:
    """A liability with an honest promisor, and what all others do to it."""

    def __init__(self, generation: int, cost: int) -> None:
        self.stage = stage()
        self.stage.begin()
        self.people = self.stage.people
        self.promisor = self.people[1]
        for provider in self.people[2:4]:
            assert self.stage.stake("refill(uint256)", 2 * XRT, provider).refusal is None
        self.generation = generation
        self.work = self._create(self.people[0], self.promisor, cost, self.stage.current_provider())
        assert self.work
        self.refundable = self.stage.evm.block + REFUND_DELAY

    def _create(self, promisee: str, promisor: str, cost: int, provider: str) -> Work | None:
        terms = Terms(
            generation=self.generation,
            token=self.stage.xrt,
            cost=cost,
            validator=ZERO_ADDRESS,
            validator_fee=0,
            lighthouse_fee=0,
            promisee=promisee,
            promisor=promisor,
        )
        orders = self.stage.orders(terms, deadline=FOREVER, offered=cost)
        answer, address = self.stage.create(orders, provider)
        return None if answer.refusal else Work(address, terms, orders, self.stage.evm.block)

    def act(self, kind: str, *arguments: Any) -> None:
        """One action of the conspirators; each may fail."""
        assert self.work
        who = self.people[arguments[0]] if kind != "wait" else ""
        match kind:
            case "fill":
                other = self.people[next(index for index in CONSPIRATORS if index != arguments[0])]
                self._create(who, other, 0, self.stage.current_provider())
            case "forge":
                signer, success, turn = self.people[arguments[1]], arguments[2], arguments[3]
                end = self.stage.finish if turn else self.stage.finish_without_turn
                assert end(self.work, success, signer, who, altered=False).refusal
            case "finish":
                self.stage.finish(self.work, True, self.promisor, who, altered=False)
            case "refund":
                assert self.stage.refund(self.work, who).refusal in ("RefundTooEarly", "AlreadyFinalized")
            case "cancel":
                assert self.stage.cancel(self.work, [self.people[0], who], who).refusal
            case "refill" | "withdraw":
                self.stage.stake(f"{kind}(uint256)", arguments[1], who)
            case "approve":
                self.stage.approve(0, who)
            case "wait":
                # The promisor's transaction is mined before the block in which the refund is possible.
                left = self.refundable - 1 - self.stage.evm.block
                self.stage.evm.advance(min(arguments[0], left))


@settings(max_examples=60 if IN_CI else 15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(generation=st.sampled_from((3, 5)), actions=st.lists(ACTION, max_size=20))
def test_a_promisor_with_a_result_in_time_is_paid_whatever_the_others_do(
    generation: int, actions: list[tuple[Any, ...]]
) -> None:
    history = Conspiracy(generation, COST)
    market, promisor = history.stage, history.promisor
    before = market.balance(market.xrt, promisor)

    for kind, *arguments in actions:
        history.act(kind, *arguments)
    assert history.work
    answer = market.finish_without_turn(history.work, True, promisor, promisor, altered=False)

    assert answer.refusal in (None, "AlreadyFinalized")
    assert market.balance(market.xrt, promisor) == before + COST
    assert market.ask(history.work.address, "isSuccess()")

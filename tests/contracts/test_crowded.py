"""A lighthouse with a thousand providers: what joining, leaving and passing over silent ones take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import pytest

from tests.support.contracts.chains import remote
from tests.support.contracts.market import Market
from tests.support.contracts.suite import XRT, Suite
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import Iterator

    from web3.contract import Contract

    from tests.support.contracts.chains import Chain
    from tests.support.contracts.suite import Person

pytestmark = pytest.mark.sample("market")

PROVIDERS: Final = 1000
AT_ONCE: Final = 100
TIMEOUT: Final = 10
PAGE: Final = 300


class Crowded:
    """A lighthouse whose turn a silent provider has, with `count` of them in all."""

    def __init__(self, market: Market, count: int) -> None:
        self.market, self.suite = market, market.suite
        self.lighthouse: Contract = self.suite.create_lighthouse(timeout=TIMEOUT, name=f"crowded-{count}")
        crowd = self.suite.deploy("Crowd")
        self.suite.send(self.suite.xrt.functions.transfer(crowd.address, count * XRT))
        for first in range(0, count, AT_ONCE):
            some = min(AT_ONCE, count - first)
            call = crowd.functions.join(self.suite.xrt.address, self.lighthouse.address, XRT, some)
            tx = call.transact({"from": self.suite.deployer.address, "gas": 29_000_000})
            assert self.suite.web3.eth.wait_for_transaction_receipt(tx, poll_latency=0.005)["status"] == 1

    def gas(self) -> dict[str, int]:
        """What two providers' transactions take: they join, the first leaves, the second passes over the silent."""
        leaver, other = self.suite.people[5:7]
        gas = {"join": self.join(leaver)}
        self.join(other)
        withdraw = self.lighthouse.functions.withdraw(XRT)
        gas["leave"] = self.suite.send(withdraw, leaver)["gasUsed"]
        self.suite.chain.mine(2 * TIMEOUT)
        gas["pass over"] = self.send(other)
        gas["leave in the middle"] = self.suite.send(withdraw, other)["gasUsed"]
        return gas

    def join(self, person: Person) -> int:
        """Make a person a provider; the gas of the stake."""
        self.suite.fund(person, 5 * XRT, self.lighthouse.address)
        return int(self.suite.send(self.lighthouse.functions.refill(XRT), person)["gasUsed"])

    def creation(self) -> Any:
        """The call that makes a free liability."""
        orders = self.market.pair(lighthouse=self.lighthouse.address)
        return self.market.creation(*orders, lighthouse=self.lighthouse)

    def send(self, person: Person) -> int:
        """A transaction of a provider's; the gas that it used."""
        return int(self.suite.send(self.creation(), person)["gasUsed"])


@pytest.fixture(scope="module")
def chain() -> Iterator[Chain]:
    """A chain that makes a thousand providers in a second."""
    with Anvil() as node:
        yield remote(node.url, node.private_keys)


@pytest.fixture(scope="module")
def market(chain: Chain) -> Market:
    """A market whose people have used their balances."""
    market = Market(Suite(chain), 5)
    market.finalize(market.create())
    return market


@pytest.fixture(scope="module")
def thousand(market: Market) -> Crowded:
    """The lighthouse with a thousand providers, for all tests."""
    return Crowded(market, PROVIDERS)


@pytest.fixture
def crowded(thousand: Crowded, undone: None) -> Crowded:
    """The same as it was at first."""
    return thousand


def test_gas_does_not_grow_with_the_number_of_providers(crowded: Crowded) -> None:
    many, few = crowded.gas(), Crowded(crowded.market, 3).gas()
    assert all(abs(many[action] - few[action]) < 200 for action in few), (few, many)
    assert many["join"] < 165_000
    assert many["leave"] < 80_000
    assert many["pass over"] < 195_000


def test_one_provider_works_beside_a_thousand_silent_ones(crowded: Crowded) -> None:
    """Each of its turns comes after two timeouts of silence, however many are silent."""
    suite, worker = crowded.suite, crowded.suite.people[5]
    crowded.join(worker)
    for _ in range(3):
        assert crowded.market.refusal(crowded.creation(), worker)[0] == "NotYourTurn"
        suite.chain.mine(2 * TIMEOUT)
        crowded.send(worker)


def test_the_queue_is_read_in_pages(crowded: Crowded) -> None:
    functions, nobody = crowded.lighthouse.functions, "0x" + "00" * 20
    listed: list[str] = []
    first = nobody
    while not listed or first != nobody:
        accounts, stakes, first = functions.queue(first, PAGE).call({"gas": 5_000_000})
        assert len(accounts) <= PAGE
        assert stakes == [XRT] * len(accounts)
        listed += accounts
    assert len(set(listed)) == len(listed) == functions.providersLength().call() == PROVIDERS
    assert listed[0] == functions.current().call()
    assert functions.queue(crowded.suite.deployer.address, PAGE).call() == [[], [], nobody]
    assert functions.queue(listed[-1], PAGE).call() == [[listed[-1]], [XRT], nobody]

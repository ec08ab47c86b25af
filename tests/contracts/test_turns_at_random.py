"""Invariants of a lighthouse under random actions of its providers."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

import pytest

from tests.contracts.suite import XRT

if TYPE_CHECKING:
    from web3.contract import Contract

    from tests.contracts.market import Market
    from tests.contracts.suite import Person

TIMEOUT = 5
STEPS = 30


class Walk:
    """Providers that join, leave, send and stay silent at random."""

    def __init__(self, market: Market, chance: Random) -> None:
        self.market = market
        self.suite = market.suite
        self.chance = chance
        self.lighthouse: Contract = self.suite.create_lighthouse(timeout=TIMEOUT, name="walk")
        self.people = self.suite.people[5:8]
        for person in self.people:
            self.suite.fund(person, 50 * XRT, self.lighthouse.address)

    def step(self) -> None:
        """One action of an account."""
        person = self.chance.choice(self.people)
        stake = self.lighthouse.functions.stakes(person.address).call()
        match self.chance.choice(("send", "send", "send", "refill", "withdraw", "silence")):
            case "refill":
                self.suite.send(self.lighthouse.functions.refill(self.chance.randint(1, 3) * XRT), person)
            case "withdraw" if stake:
                self.suite.send(self.lighthouse.functions.withdraw(self.chance.randint(0, stake)), person)
            case "silence":
                self.suite.chain.mine(self.chance.randint(1, 2 * TIMEOUT))
            case _:
                self.send(self.providers())

    def send(self, providers: list[Person]) -> None:
        """A transaction of one of the providers that may send; there always is one."""
        if not providers:
            return
        orders = self.market.pair(lighthouse=self.lighthouse.address)
        call = self.market.creation(*orders, lighthouse=self.lighthouse)
        allowed = [person for person in providers if self.market.refusal(call, person) == ()]
        assert allowed
        self.suite.send(call, self.chance.choice(allowed))

    def providers(self) -> list[Person]:
        """The accounts with a stake."""
        return [person for person in self.people if self.lighthouse.functions.indexOf(person.address).call()]

    def check(self) -> None:
        """What must hold after every step."""
        functions = self.lighthouse.functions
        listed = [functions.providers(index).call() for index in range(functions.providersLength().call())]
        assert sorted(listed) == sorted(person.address for person in self.providers())
        assert [functions.indexOf(address).call() for address in listed] == list(range(1, len(listed) + 1))
        stakes = {person.address: functions.stakes(person.address).call() for person in self.people}
        assert self.suite.balance(self.lighthouse) == sum(stakes.values())
        assert all((stakes[person.address] >= XRT) == (person.address in listed) for person in self.people)
        marker, quota = functions.marker().call(), functions.quota().call()
        if not listed:
            assert (marker, quota) == (0, 0)
            return
        assert functions.current().call() == listed[marker - 1]
        assert 1 <= quota <= functions.quotaOf(listed[marker - 1]).call()
        assert functions.isTurnOf(listed[marker - 1]).call()


@pytest.mark.parametrize("seed", [1, 2])
def test_stakes_turns_and_the_list_of_providers_agree(third: Market, seed: int) -> None:
    walk = Walk(third, Random(seed))
    for _ in range(STEPS):
        walk.step()
        walk.check()

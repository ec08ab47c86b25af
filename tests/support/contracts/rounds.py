"""A lighthouse of the contract tests, whose providers take turns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from collections.abc import Iterable

    from web3.contract import Contract

    from tests.support.contracts.market import Market
    from tests.support.contracts.suite import Person, Suite

TIMEOUT = 10


class Round:
    """A lighthouse with the cheapest transactions: attempts to finalize an address that is not a liability."""

    def __init__(self, market: Market, stakes: Iterable[int]) -> None:
        self.market = market
        self.suite: Suite = market.suite
        self.lighthouse: Contract = self.suite.create_lighthouse(timeout=TIMEOUT, name="round")
        self.providers = self.suite.people[5:]
        for provider, stake in zip(self.providers, stakes, strict=False):
            self.suite.join(self.lighthouse, provider, stake * XRT)

    def send(self, provider: Person) -> None:
        """A transaction of that provider's, which must be allowed."""
        orders = self.market.pair(lighthouse=self.lighthouse.address)
        self.suite.send(self.market.creation(*orders, lighthouse=self.lighthouse), provider)

    def may_send(self, *providers: Person) -> list[bool]:
        """Which of these may send the next transaction."""
        call = self.market.creation(*self.market.pair(lighthouse=self.lighthouse.address), lighthouse=self.lighthouse)
        allowed = []
        for provider in providers:
            refusal = self.market.refusal(call, provider)
            assert refusal[:1] in ((), ("NotYourTurn",))
            allowed.append(refusal == ())
        return allowed

    def read(self, name: str, *arguments: Any) -> Any:
        """A getter's answer."""
        return self.lighthouse.functions[name](*arguments).call()

"""What everybody ought to hold: the market's money kept a second time, by the rules as the README has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from schemas import ZERO_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Iterable

GAS_OF_GENERATION: Final = {3: 268_000, 5: 224_000}
GAS_OF_COST: Final = 51_000
GAS_OF_LIGHTHOUSE_FEE: Final = 19_500
UNLIMITED: Final = 2**256 - 1


@dataclass(frozen=True, kw_only=True)
class Terms:
    """What a liability was made of; the cost in the token's smallest unit, fees in wn, parties by address."""

    generation: int
    token: str
    cost: int
    validator: str
    validator_fee: int
    lighthouse_fee: int
    promisee: str
    promisor: str

    @property
    def judging(self) -> int:
        """The fee that is kept for the validator, in wn; without one it is not taken."""
        return 0 if self.validator == ZERO_ADDRESS else self.validator_fee

    @property
    def gas(self) -> int:
        """The gas that is counted at the end."""
        gas = GAS_OF_GENERATION[self.generation]
        return gas + GAS_OF_COST * (self.cost > 0) + GAS_OF_LIGHTHOUSE_FEE * (self.lighthouse_fee > 0)


@dataclass(frozen=True)
class Payment:
    """One movement of a token."""

    token: str
    giver: str
    receiver: str
    value: int


@dataclass
class Books:
    """Balances by token and holder, what the factory and the lighthouse may take, stakes, and the supply of XRT.

    `blocked` are the accounts that the foreign token refuses to pay, and `owed` is what it has refused to pay to each.
    """

    xrt: str
    factory: str
    lighthouse: str
    minimal_stake: int
    balances: dict[tuple[str, str], int]
    supply: int
    allowances: dict[str, int] = field(default_factory=dict)
    stakes: dict[str, int] = field(default_factory=dict)
    blocked: set[str] = field(default_factory=set)
    owed: dict[tuple[str, str], int] = field(default_factory=dict)
    gas: int = 0

    def create(self, terms: Terms, provider: str) -> str | None:
        """Take the costs of a liability; if an account can't pay, take nothing and return the refusal."""
        return self._transfer(
            [
                Payment(self.xrt, terms.promisor, provider, terms.lighthouse_fee),
                Payment(terms.token, terms.promisee, self.factory, terms.cost),
                Payment(self.xrt, terms.promisee, self.factory, terms.judging),
            ]
        )

    def finish(self, terms: Terms, *, paid: bool, provider: str | None) -> None:
        """Pay for a liability that ends with a result; `provider` is None if it was ended without a turn."""
        self._pay_cost(terms, terms.promisor if paid else terms.promisee)
        self._give(self.xrt, self.factory, terms.validator, terms.judging)
        self.gas += terms.gas
        accounts = {terms.promisee, terms.promisor, provider}
        if paid and provider is not None and len(accounts) == 3 and terms.token == self.xrt:
            minted = min(terms.gas, terms.cost)
            self.supply += minted
            self.balances[self.xrt, provider] += minted

    def give_back(self, terms: Terms) -> None:
        """Return the cost and the validator's fee to the promisee."""
        self._pay_cost(terms, terms.promisee)
        self._give(self.xrt, self.factory, terms.promisee, terms.judging)
        self.gas += terms.gas

    def claim(self, token: str, account: str, to: str) -> str | None:
        """Pay an account, at `to`, what it is owed, or the refusal."""
        value = self.owed.get((token, account), 0)
        if not value:
            return "NothingOwed"
        if to in self.blocked:
            return "refused by the token"
        del self.owed[token, account]
        self._give(token, self.factory, to, value)
        return None

    def refill(self, provider: str, value: int) -> str | None:
        """Stake more, or the refusal."""
        stake = self.stakes.get(provider, 0) + value
        if stake < self.minimal_stake:
            return "StakeTooSmall"
        if self.balances[self.xrt, provider] < value:
            return "ERC20InsufficientBalance"
        self._give(self.xrt, provider, self.lighthouse, value)
        self.stakes[provider] = stake
        return None

    def withdraw(self, provider: str, value: int) -> str | None:
        """Take from a stake, or the refusal; what would be too small to stay is paid out as well."""
        stake = self.stakes.get(provider, 0)
        if stake == 0:
            return "NotAProvider"
        if value > stake:
            return "InsufficientStake"
        left = stake - value
        if left < self.minimal_stake:
            value, left = stake, 0
        self._give(self.xrt, self.lighthouse, provider, value)
        self.stakes[provider] = left
        return None

    def held_for(self, open_terms: Iterable[Terms]) -> dict[str, int]:
        """What the factory has to hold for liabilities that are open and for what is owed, by token."""
        held = {token: 0 for token, _ in self.balances}
        for (token, _), value in self.owed.items():
            held[token] += value
        for terms in open_terms:
            held[terms.token] += terms.cost
            held[self.xrt] += terms.judging
        return held

    def _transfer(self, payments: list[Payment]) -> str | None:
        """Make all payments from what the factory may take, or none of them."""
        before = dict(self.balances), dict(self.allowances)
        for payment in payments:
            refusal = self._take(payment)
            if refusal:
                self.balances, self.allowances = before
                return refusal
        return None

    def _take(self, payment: Payment) -> str | None:
        if payment.value == 0:
            return None
        if payment.token == self.xrt:
            allowed = self.allowances[payment.giver]
            if allowed < payment.value:
                return "ERC20InsufficientAllowance"
            if allowed != UNLIMITED:
                self.allowances[payment.giver] -= payment.value
        if self.balances[payment.token, payment.giver] < payment.value:
            return "ERC20InsufficientBalance" if payment.token == self.xrt else "Panic"
        self._give(payment.token, payment.giver, payment.receiver, payment.value)
        return None

    def _pay_cost(self, terms: Terms, receiver: str) -> None:
        if terms.token != self.xrt and receiver in self.blocked and terms.cost:
            self.owed[terms.token, receiver] = self.owed.get((terms.token, receiver), 0) + terms.cost
        else:
            self._give(terms.token, self.factory, receiver, terms.cost)

    def _give(self, token: str, giver: str, receiver: str, value: int) -> None:
        if value:
            self.balances[token, giver] -= value
            self.balances[token, receiver] += value

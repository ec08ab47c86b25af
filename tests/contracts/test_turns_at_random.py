"""Turns under random actions of the providers, against a model of the queue.

The model is a list of accounts. At each step the lighthouse must refuse and change what the model does. A provider that
waits must not be set back, unless it had a whole timeout alone to take the turn. `AIRA_TURN_HISTORIES` is the number of
histories.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from eth_abi.abi import decode
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from schemas import ZERO_ADDRESS, checksum_address
from tests.support.ci import IN_CI
from tests.support.contracts.books import Terms
from tests.support.contracts.stage import FOREVER, TIMEOUT, Stage
from tests.support.contracts.suite import XRT

if TYPE_CHECKING:
    from tests.support.contracts.evm import Answer

PERSON: Final = st.integers(0, 4)
HISTORIES: Final = int(os.environ.get("AIRA_TURN_HISTORIES", "30" if IN_CI else "8"))


@cache
def stage() -> Stage:
    """The contracts, deployed once."""
    return Stage()


@dataclass
class Queue:
    """The providers in the order of their turns, and who may send when, by the rules as the README has them."""

    block: int
    order: list[str] = field(default_factory=list)
    quotas: dict[str, int] = field(default_factory=dict)
    left: int = 0
    alive: int = 0
    alone: dict[str, int] = field(default_factory=dict)
    """In how many blocks the next one, and nobody else, could have taken the turn."""

    @property
    def timeouts(self) -> int:
        """How many timeouts have passed in silence."""
        return max(self.block - self.alive - 1, 0) // TIMEOUT

    def refusal(self, person: str) -> str | None:
        """Why an account can't send in this block."""
        if person not in self.order:
            return "NotAProvider"
        place = self.order.index(person)
        return None if place == 0 or self.timeouts > 1 or (self.timeouts == 1 and place == 1) else "NotYourTurn"

    def send(self, person: str) -> None:
        """A transaction of an account that may send."""
        place = self.order.index(person)
        if place:
            silent = self.order[: min(place, 2)]
            self.order = [person, *(other for other in self.order if other not in (person, *silent)), *silent]
            self.left = self.quotas[person]
        self.left -= 1
        if self.left == 0:
            self.order.append(self.order.pop(0))
            self.left = self.quotas[self.order[0]]
        self.alive = self.block

    def stake(self, person: str, quota: int) -> None:
        """An account joins, leaves with a quota of 0, or changes its stake."""
        if quota == 0:
            self._leave(person)
        elif person not in self.order:
            self.order.append(person)
            if len(self.order) == 1:
                self.left, self.alive = quota, self.block
            elif len(self.order) == 2:
                self._shorten()
        elif self.order[0] == person:
            self.left = min(self.left, quota)
        self.quotas[person] = quota

    def _leave(self, person: str) -> None:
        place = self.order.index(person)
        self.order.remove(person)
        if self.order and place == 0:
            self.left = self.quotas[self.order[0]]
        if place < 2:
            self._shorten()

    def _shorten(self) -> None:
        if self.timeouts > 1:
            self.alive = self.block - TIMEOUT

    def advance(self, blocks: int) -> None:
        """Let blocks pass, and count in which the next one had its chance."""
        for _ in range(blocks):
            following = self.order[1] if len(self.order) > 1 else ""
            self.alone = {following: self.alone.get(following, 0) + (self.timeouts == 1)}
            self.block += 1


class Providers(RuleBasedStateMachine):
    """Providers that join, leave, send and stay silent at random."""

    def __init__(self) -> None:
        super().__init__()
        self.stage = stage()
        self.stage.begin()
        self.queue = Queue(self.stage.evm.block)
        self.before: list[str] = []

    @initialize(stakes=st.lists(st.integers(1, 3), min_size=1, max_size=5))
    def begins(self, stakes: list[int]) -> None:
        for person, stake in zip(self.stage.people, stakes, strict=False):
            self.stakes(self.stage.people.index(person), stake, "refill")

    @rule(person=PERSON)
    def sends(self, person: int) -> None:
        account, waiting = self.stage.people[person], list(self.queue.order)
        refusal = self.queue.refusal(account)
        chances = dict(self.queue.alone)
        assert bool(self.stage.ask(self.stage.lighthouse, "isTurnOf(address)", account)) == (refusal is None)
        assert self.send(account).refusal == refusal
        if refusal is None:
            self.queue.send(account)
            self.nobody_is_set_back(waiting, account, chances)

    @rule(person=PERSON, times=st.sampled_from((1, 1, 2, 3)), how=st.sampled_from(("refill", "refill", "withdraw")))
    def stakes(self, person: int, times: int, how: str) -> None:
        account, waiting = self.stage.people[person], list(self.queue.order)
        quota = self.queue.quotas.get(account, 0)
        if how == "withdraw" and times > quota:
            return
        assert self.stage.stake(f"{how}(uint256)", times * XRT, account).refusal is None
        self.queue.stake(account, quota + times if how == "refill" else quota - times)
        self.nobody_is_set_back(waiting, account, {})

    @rule(person=PERSON)
    def leaves(self, person: int) -> None:
        quota = self.queue.quotas.get(self.stage.people[person], 0)
        if quota:
            self.stakes(person, quota, "withdraw")

    @rule(blocks=st.sampled_from((1, TIMEOUT - 1, TIMEOUT, TIMEOUT + 1, 2 * TIMEOUT + 1, 2 * TIMEOUT + 1)))
    def is_silent(self, blocks: int) -> None:
        self.stage.evm.advance(blocks)
        self.queue.advance(blocks)

    def nobody_is_set_back(self, waiting: list[str], actor: str, chances: dict[str, int]) -> None:
        """None of those who were waiting is further from its turn, but who let a timeout alone pass."""
        for place, account in enumerate(waiting[1:], 1):
            if account != actor and self.queue.order.index(account) > place:
                assert place == 1
                assert chances[account] >= TIMEOUT

    def send(self, account: str) -> Answer:
        """A transaction of that provider's: a free liability."""
        terms = Terms(
            generation=3,
            token=self.stage.xrt,
            cost=0,
            validator=ZERO_ADDRESS,
            validator_fee=0,
            lighthouse_fee=0,
            promisee=self.stage.people[0],
            promisor=self.stage.people[1],
        )
        return self.stage.create(self.stage.orders(terms, deadline=FOREVER, offered=0), account)[0]

    @invariant()
    def lighthouse_and_model_agree(self) -> None:
        queue, lighthouse = self.queue, self.stage.lighthouse
        accounts, stakes, following = self.listed(ZERO_ADDRESS, 10)
        assert (accounts, following) == (queue.order, ZERO_ADDRESS)
        assert stakes == [queue.quotas[account] * XRT for account in accounts]
        assert self.stage.stored_balance(self.stage.xrt, lighthouse) == sum(stakes)
        assert self.stage.ask(lighthouse, "quota()") == (queue.left if queue.order else 0)
        assert self.stage.ask(lighthouse, "providersLength()") == len(queue.order)
        places = [self.stage.ask(lighthouse, "indexOf(address)", account) for account in queue.order]
        assert sorted(places) == list(range(1, len(places) + 1))
        assert self.stage.ask(lighthouse, "marker()") == (places[0] if places else 0)

    def listed(self, first: str, limit: int) -> tuple[list[str], list[int], str]:
        """A page of the queue."""
        keeper = self.stage.keeper
        output = self.stage.evm.call(
            self.stage.lighthouse, "queue(address,uint256)", first, limit, sender=keeper
        ).output
        decoded: tuple[Any, ...] = decode(["address[]", "uint256[]", "address"], output)
        return [checksum_address(bytes.fromhex(account[2:])) for account in decoded[0]], list(decoded[1]), decoded[2]


def test_turns_follow_the_model_and_set_nobody_back() -> None:
    run_state_machine_as_test(
        Providers,
        settings=settings(
            max_examples=HISTORIES,
            stateful_step_count=20,
            deadline=None,
            phases=(Phase.explicit, Phase.reuse, Phase.generate),
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
        ),
    )

"""Invariants of the money under random actions: none is lost or paid twice, and all can be withdrawn in the end.

Histories are made up by Hypothesis: orders of both generations, paid in XRT and in a token that refuses to pay those on
its blocklist, that are taken, finished well or badly, judged, refunded, cancelled and sent again, while providers come
and go. Each call must be refused for the reason that the books give, or change what they change and nothing else.
`AIRA_MONEY_HISTORIES` says how many histories to play; CI plays 2,000 in a step of its own.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Final

import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    MultipleResults,
    RuleBasedStateMachine,
    initialize,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)

from schemas import ZERO_ADDRESS
from tests.support.ci import seed_of_part
from tests.support.contracts.choices import AGREEMENT, ALLOWANCES, ANYBODY, MOSTLY, NEXT, PARTY, PROVIDER, STAKES, stage
from tests.support.contracts.stage import FOREVER, TIMEOUT, Work
from tests.support.contracts.suite import REFUND_DELAY, XRT

if TYPE_CHECKING:
    from tests.support.contracts.books import Terms
    from tests.support.contracts.evm import Answer

HISTORIES: Final = int(os.environ.get("AIRA_MONEY_HISTORIES", "10"))
AT_A_TIME: Final = 100
"""Histories in one test: few enough to stay far below the time limit of a test."""

STEPS: Final = 15


class Histories(RuleBasedStateMachine):
    """A history of the market; `works` are its liabilities, those that have ended too."""

    works: Bundle[Work] = Bundle("works")

    def __init__(self) -> None:
        super().__init__()
        self.stage = stage()
        self.books = self.stage.begin()
        self.made: list[Work] = []

    @initialize(
        target=works,
        stakes=st.tuples(*[st.sampled_from((3 * XRT, XRT, 0))] * 2, st.just(3 * XRT)),
        terms=st.lists(AGREEMENT, min_size=1, max_size=3),
    )
    def begins(self, stakes: tuple[int, ...], terms: list[Terms]) -> MultipleResults[Work]:
        for person, stake in zip(self.stage.people[2:], stakes, strict=True):
            self.stakes(person, stake, "refill")
        works = (self.agree(each, NEXT, None) for each in terms)
        return multiple(*(work for work in works if work))

    @rule(target=works, terms=AGREEMENT, provider=PROVIDER, flaw=st.sampled_from((None, None, None, "cost", "late")))
    def agrees(self, terms: Terms, provider: str, flaw: str | None) -> Work | MultipleResults[Work]:
        return self.agree(terms, provider, flaw) or multiple()

    def agree(self, terms: Terms, provider: str, flaw: str | None) -> Work | None:
        """A provider creates a liability, or tries to."""
        provider = self.sender(provider)
        deadline = self.stage.evm.block if flaw == "late" else FOREVER
        orders = self.stage.orders(terms, deadline=deadline, offered=terms.cost + (flaw == "cost"))
        refusal = self.not_the_turn_of(provider)
        if flaw and not refusal:
            refusal = {"cost": "CostMismatch", "late": "DeadlineReached"}[flaw]
        refusal = refusal or self.books.create(terms, provider)
        answer, address = self.stage.create(orders, provider)
        assert answer.refusal == refusal
        if refusal:
            return None
        work = Work(address, terms, orders, self.stage.evm.block)
        self.made.append(work)
        return work

    @rule(work=works, provider=PROVIDER)
    def sends_orders_again(self, work: Work, provider: str) -> None:
        provider = self.sender(provider)
        used = "OrderUsed" if work.terms.generation == 3 else "WrongSigner"
        answer, _ = self.stage.create(work.orders, provider)
        assert answer.refusal == (self.not_the_turn_of(provider) or used)

    @rule(work=works, provider=PROVIDER, success=MOSTLY, forged=st.sampled_from((None, None, None, "signer", "result")))
    def finishes(self, work: Work, provider: str, success: bool, forged: str | None) -> None:
        provider, terms = self.sender(provider), work.terms
        right = terms.promisor if terms.validator == ZERO_ADDRESS else self.stage.judge
        signer = self.somebody_but(right) if forged == "signer" else right
        refusal = self.not_the_turn_of(provider)
        if not refusal and terms.validator != ZERO_ADDRESS and terms.generation == 3:
            refusal = "NotTheValidator"
        if not refusal and forged:
            refusal = "WrongSigner" if terms.validator == ZERO_ADDRESS else "RefusedByValidator"
        answer = self.stage.finish(work, success, signer, provider, altered=forged == "result")
        if self.ends(work, answer, refusal, paid=success):
            self.books.finish(terms, paid=success, provider=provider)

    @rule(work=works, caller=ANYBODY, success=MOSTLY, forged=st.sampled_from((None, None, None, "signer", "result")))
    def finishes_without_turn(self, work: Work, caller: str, success: bool, forged: str | None) -> None:
        terms = work.terms
        right = terms.promisor if terms.validator == ZERO_ADDRESS else self.stage.judge
        signer = self.somebody_but(right) if forged == "signer" else right
        refusal = None
        if terms.validator != ZERO_ADDRESS and terms.generation == 3:
            refusal = "NotTheValidator"
        elif forged:
            refusal = "WrongSigner" if terms.validator == ZERO_ADDRESS else "RefusedByValidator"
        answer = self.stage.finish_without_turn(work, success, signer, caller, altered=forged == "result")
        if self.ends(work, answer, refusal, paid=success):
            self.books.finish(terms, paid=success, provider=None)

    @rule(
        work=works.filter(lambda work: work.terms.generation == 3),
        success=MOSTLY,
        agree=MOSTLY,
        forged=st.sampled_from((None, None, None, "caller", "signer", "result")),
    )
    def judges(self, work: Work, success: bool, agree: bool, forged: str | None) -> None:
        terms, judge = work.terms, self.stage.judge
        caller = self.somebody_but(judge) if forged == "caller" else judge
        signer = self.somebody_but(terms.promisor) if forged == "signer" else terms.promisor
        refusal = "WrongSigner" if forged else None
        if terms.validator != caller:
            refusal = "NotTheValidator"
        answer = self.stage.judge_result(work, (success, agree), signer, caller, altered=forged == "result")
        if self.ends(work, answer, refusal, paid=success and agree):
            self.books.finish(terms, paid=success and agree, provider=None)

    @rule(work=works, caller=ANYBODY)
    def asks_for_a_refund(self, work: Work, caller: str) -> None:
        too_early = self.stage.evm.block < work.made_at + REFUND_DELAY
        answer = self.stage.refund(work, caller)
        if self.ends(work, answer, "RefundTooEarly" if too_early else None, paid=False):
            self.books.give_back(work.terms)

    @rule(work=works, caller=ANYBODY, forged=st.sampled_from((None, None, 0, 1)))
    def cancels(self, work: Work, caller: str, forged: int | None) -> None:
        signers = [work.terms.promisee, work.terms.promisor]
        if forged is not None:
            signers[forged] = self.somebody_but(signers[forged])
        answer = self.stage.cancel(work, signers, caller)
        if self.ends(work, answer, None if forged is None else "WrongSigner", paid=False):
            self.books.give_back(work.terms)

    @rule(person=PROVIDER, value=STAKES, how=st.sampled_from(("refill", "withdraw")))
    def stakes(self, person: str, value: int, how: str) -> None:
        person = self.sender(person)
        answer = self.stage.stake(f"{how}(uint256)", value, person)
        kept = self.books.refill if how == "refill" else self.books.withdraw
        assert answer.refusal == kept(person, value)

    @rule(person=ANYBODY, value=ALLOWANCES)
    def approves(self, person: str, value: int) -> None:
        assert self.stage.approve(value, person).refusal is None
        self.books.allowances[person] = value

    @rule(person=PARTY, is_blocked=st.booleans(), way=st.integers(0, 3))
    def blocks(self, person: str, is_blocked: bool, way: int) -> None:
        self.stage.block(person, is_blocked=is_blocked, way=way)
        (self.books.blocked.add if is_blocked else self.books.blocked.discard)(person)

    @rule(person=PARTY, caller=ANYBODY)
    def claims(self, person: str, caller: str) -> None:
        self.claimed(self.books.claim(self.stage.foreign, person, person), self.stage.claim(person, caller))

    @rule(person=PARTY, to=ANYBODY)
    def claims_to(self, person: str, to: str) -> None:
        self.claimed(self.books.claim(self.stage.foreign, person, to), self.stage.claim_to(person, to))

    def claimed(self, refusal: str | None, answer: Answer) -> None:
        if refusal == "refused by the token":
            assert answer.refusal in ("", "TokenTransferFailed")
        else:
            assert answer.refusal == refusal

    @rule(blocks=st.sampled_from((1, TIMEOUT + 1, 2 * TIMEOUT + 1, REFUND_DELAY)))
    def blocks_pass(self, blocks: int) -> None:
        self.stage.evm.advance(blocks)

    @invariant()
    def everybody_holds_what_the_books_say(self) -> None:
        for (token, holder), value in self.books.balances.items():
            assert self.stage.stored_balance(token, holder) == value, (token, holder)

    @invariant()
    def no_token_is_lost_or_made_but_by_the_emission(self) -> None:
        assert self.stage.ask(self.stage.xrt, "totalSupply()") == self.books.supply
        held = dict.fromkeys((self.stage.xrt, self.stage.foreign), 0)
        for (token, _), value in self.books.balances.items():
            held[token] += value
        assert held == {self.stage.xrt: self.books.supply, self.stage.foreign: self.stage.foreign_supply}

    @invariant()
    def the_factory_holds_what_open_liabilities_hold_and_what_it_owes(self) -> None:
        held = self.books.held_for(work.terms for work in self.made if not work.ended)
        assert {token: self.stage.stored_balance(token, self.stage.factory) for token in held} == held
        for person in self.stage.people:
            assert self.stage.owed(person) == self.books.owed.get((self.stage.foreign, person), 0)
        assert self.stage.stored_balance(self.stage.xrt, self.stage.lighthouse) == sum(self.books.stakes.values())

    def teardown(self) -> None:
        """Everything can be withdrawn: open liabilities are finalized or refunded, and stakes, fees and debts paid."""
        if sys.exc_info()[0] is not None:
            return
        self.stage.evm.advance(REFUND_DELAY)
        for number, work in enumerate([work for work in self.made if not work.ended], self.stage.evm.block % 4):
            self.end_somehow(work, number)
        for _, person in list(self.books.owed):
            self.claims_to(person, self.stage.judge)  # whom nobody blocks
        for person, stake in list(self.books.stakes.items()):
            self.stakes(person, stake, "withdraw")
        for (token, holder), value in self.books.balances.items():
            assert self.stage.balance(token, holder) == value
            assert value == 0 or holder not in (self.stage.factory, self.stage.lighthouse)
        for person, value in self.books.allowances.items():
            assert self.stage.allowance(person) == value
        for work in self.made:
            assert self.stage.ask(work.address, "isFinalized()")
            assert self.stage.ask(work.address, "isSuccess()") == work.paid
        assert self.stage.ask(self.stage.factory, "totalGasConsumed()") == self.books.gas
        self.stage.collect_fees()
        assert self.stage.balance(self.stage.xrt, self.stage.jury) == 0

    def end_somehow(self, work: Work, number: int) -> None:
        """Every second one is refunded, the others get a result; which ones depends on the block that it is."""
        turn = next((person for person in self.stage.people[2:] if not self.not_the_turn_of(person)), None)
        if number % 2 == 0:
            self.asks_for_a_refund(work, self.stage.judge)
        elif work.terms.generation == 3 and work.terms.validator != ZERO_ADDRESS:
            self.judges(work, success=True, agree=number % 4 == 1, forged=None)
        elif turn is not None:
            self.finishes(work, turn, success=True, forged=None)
        else:
            self.finishes_without_turn(work, self.stage.judge, success=True, forged=None)

    def ends(self, work: Work, answer: Answer, refusal: str | None, *, paid: bool) -> bool:
        """Whether a call ended the liability; it must have been refused for `refusal`, or if it has ended before."""
        if work.ended:
            refusal = refusal or "AlreadyFinalized"
        assert answer.refusal == refusal
        if refusal is None:
            work.ended, work.paid = True, paid
        return refusal is None

    def not_the_turn_of(self, person: str) -> str | None:
        """Why a provider can't send now. The order of turns is tested in the tests of turns."""
        if not self.books.stakes.get(person):
            return "NotAProvider"
        return None if self.stage.ask(self.stage.lighthouse, "isTurnOf(address)", person) else "NotYourTurn"

    def sender(self, provider: str) -> str:
        """The account of a chosen provider; `NEXT` is the current one."""
        return self.stage.current_provider() if provider == NEXT else provider

    def somebody_but(self, person: str) -> str:
        """Another one."""
        return next(other for other in self.stage.people if other != person)


def play(histories: type[Histories], number: int) -> None:
    run_state_machine_as_test(
        histories,
        settings=settings(
            max_examples=number,
            stateful_step_count=STEPS,
            deadline=None,
            # To make a history that fails shorter can take longer than a test may; they are short as they are.
            phases=(Phase.explicit, Phase.reuse, Phase.generate),
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
        ),
    )


@pytest.mark.parametrize("first", range(0, HISTORIES, AT_A_TIME))
def test_money_is_neither_lost_nor_paid_twice(first: int) -> None:
    play(seed(seed_of_part(first))(Histories), min(AT_A_TIME, HISTORIES - first))


def test_each_part_plays_other_histories() -> None:
    played: list[set[str]] = []

    class Noted(Histories):
        def teardown(self) -> None:
            super().teardown()
            played[-1].add(repr([(work.terms, work.made_at) for work in self.made]))

    for first in (0, AT_A_TIME):
        played.append(set())
        play(seed(seed_of_part(first))(Noted), 4)
    # The first history of Hypothesis is the simplest one.
    assert len(played[0] & played[1]) <= 1 < len(played[0] | played[1])

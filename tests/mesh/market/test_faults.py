"""Whose order it is that a contract refuses, for each error that tells."""

from __future__ import annotations

from typing import Any

import pytest

from mesh.market import Match
from mesh.market.faults import at_fault, word_for
from tests.support.orders import LIGHTHOUSE, PERSON, ROBOT, STRANGER, verified_demand, verified_offer

DEMAND = verified_demand(cost=10, validator_fee=20, deadline=50)
OFFER = verified_offer(cost=10, lighthouse_fee=30, deadline=60)
MATCH = Match(DEMAND, OFFER)
FACTORY = LIGHTHOUSE


@pytest.mark.parametrize(
    ("reason", "arguments", "guilty"),
    [
        ("OrderUsed", (DEMAND.hash,), (DEMAND,)),
        ("OrderUsed", (OFFER.hash,), (OFFER,)),
        ("OrderUsed", ("0x" + OFFER.hash.hex(),), (OFFER,)),
        ("OrderUsed", (bytes(32),), MATCH),
        ("DeadlineReached", (50,), (DEMAND,)),
        ("DeadlineReached", (60,), (OFFER,)),
        ("DeadlineReached", (70,), MATCH),
        ("WrongSigner", (PERSON.address, STRANGER.address), (DEMAND,)),
        ("WrongSigner", (ROBOT.address, STRANGER.address), (OFFER,)),
        ("WrongSigner", (STRANGER.address, PERSON.address), MATCH),
        ("ERC20InsufficientBalance", (PERSON.address, 1, 10), (DEMAND,)),
        ("ERC20InsufficientBalance", (ROBOT.address, 1, 30), (OFFER,)),
        ("ERC20InsufficientBalance", (ROBOT.address.lower(), 1, 30), (OFFER,)),
        ("ERC20InsufficientBalance", (STRANGER.address, 1, 30), MATCH),
        ("ERC20InsufficientAllowance", (FACTORY, 0, 10), (DEMAND,)),
        ("ERC20InsufficientAllowance", (FACTORY, 0, 20), (DEMAND,)),
        ("ERC20InsufficientAllowance", (FACTORY, 0, 30), (OFFER,)),
        ("ValidatorWithoutCode", (STRANGER.address,), (DEMAND,)),
        ("InvalidSignature", (), MATCH),
        ("CostMismatch", (), MATCH),
        ("TokenTransferFailed", (STRANGER.address,), MATCH),
        ("", (), MATCH),
        ("some text of a stranger's token", (), MATCH),
    ],
)
def test_each_error_tells_of_its_order(reason: str, arguments: tuple[Any, ...], guilty: tuple[Any, ...]) -> None:
    assert at_fault(MATCH, reason, arguments) == tuple(guilty)


@pytest.mark.parametrize(
    ("reason", "word"), [("CostMismatch", "CostMismatch"), ("", "Reverted"), ("please pay\nme", "Reverted")]
)
def test_a_strangers_text_is_no_word(reason: str, word: str) -> None:
    assert word_for(reason) == word


@pytest.mark.parametrize("fees", [{"cost": 30}, {"validator_fee": 30}], ids=lambda fees: next(iter(fees)))
def test_an_allowance_that_either_may_owe_is_both_s_fault(fees: dict[str, Any]) -> None:
    match = Match(verified_demand(**({"cost": 10} | fees)), OFFER)

    assert at_fault(match, "ERC20InsufficientAllowance", (FACTORY, 0, 30)) == tuple(match)


def test_one_who_deals_with_himself_is_at_fault_twice() -> None:
    match = Match(DEMAND, verified_offer(signer=PERSON))

    assert at_fault(match, "ERC20InsufficientBalance", (PERSON.address, 0, 1)) == tuple(match)


def test_equal_deadlines_are_both_s_fault() -> None:
    match = Match(DEMAND, verified_offer(deadline=50))

    assert at_fault(match, "DeadlineReached", (50,)) == tuple(match)


@pytest.mark.parametrize(
    "reason", ["OrderUsed", "DeadlineReached", "WrongSigner", "ERC20InsufficientBalance", "ERC20InsufficientAllowance"]
)
def test_an_error_without_its_arguments_tells_of_both(reason: str) -> None:
    guilty = (DEMAND,) if reason == "ERC20InsufficientAllowance" else tuple(MATCH)

    assert at_fault(MATCH, reason, ()) == guilty

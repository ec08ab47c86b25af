"""Which order of a match caused an error of the contracts."""

from __future__ import annotations

from typing import Any

import pytest

from mesh.chain import Reverted
from mesh.market import Match
from mesh.market._settlement import at_fault, reason_of
from tests.support.orders import LIGHTHOUSE, PERSON, ROBOT, STRANGER, verified_demand, verified_offer

DEMAND = verified_demand(cost=10, validator_fee=20, deadline=50)
OFFER = verified_offer(cost=10, lighthouse_fee=30, deadline=60)
MATCH = Match(DEMAND, OFFER)
FACTORY = LIGHTHOUSE


@pytest.mark.parametrize(
    ("reason", "arguments", "expected"),
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
def test_each_error_names_the_orders_at_fault(
    reason: str, arguments: tuple[Any, ...], expected: tuple[Any, ...]
) -> None:
    assert at_fault(MATCH, reason, arguments) == tuple(expected)


@pytest.mark.parametrize(
    ("reason", "word"), [("CostMismatch", "CostMismatch"), ("", "Reverted"), ("please pay\nme", "Reverted")]
)
def test_the_text_of_an_unknown_token_is_not_a_reason(reason: str, word: str) -> None:
    assert reason_of(Reverted(reason)) == word


@pytest.mark.parametrize("fees", [{"cost": 30}, {"validator_fee": 30}], ids=lambda fees: next(iter(fees)))
def test_both_are_at_fault_for_an_allowance_that_either_may_lack(fees: dict[str, Any]) -> None:
    match = Match(verified_demand(**({"cost": 10} | fees)), OFFER)

    assert at_fault(match, "ERC20InsufficientAllowance", (FACTORY, 0, 30)) == tuple(match)


def test_both_orders_of_one_signer_are_at_fault() -> None:
    match = Match(DEMAND, verified_offer(signer=PERSON))

    assert at_fault(match, "ERC20InsufficientBalance", (PERSON.address, 0, 1)) == tuple(match)


def test_both_are_at_fault_for_equal_deadlines() -> None:
    match = Match(DEMAND, verified_offer(deadline=50))

    assert at_fault(match, "DeadlineReached", (50,)) == tuple(match)


@pytest.mark.parametrize(
    "reason", ["OrderUsed", "DeadlineReached", "WrongSigner", "ERC20InsufficientBalance", "ERC20InsufficientAllowance"]
)
def test_both_are_at_fault_for_an_error_without_arguments(reason: str) -> None:
    expected = (DEMAND,) if reason == "ERC20InsufficientAllowance" else tuple(MATCH)

    assert at_fault(MATCH, reason, ()) == expected

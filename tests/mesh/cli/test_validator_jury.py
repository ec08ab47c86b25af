"""`aira validator deploy` and `aira validator collect`."""

from __future__ import annotations

import pytest

from mesh.amounts import InvalidAmount
from mesh.chain import XRT, InsufficientTokens, Reverted
from mesh.errors import ChainError, InputError
from schemas import address_bytes
from schemas.errors import InvalidAddress
from tests.support.cli.served_chain import ServedChain, columns
from tests.support.commands import refused


def ascending(served: ServedChain, *roles: str) -> list[str]:
    """The addresses of people, as contracts list jurors."""
    return sorted((served.people[role].address for role in roles), key=address_bytes)


def pay(served: ServedChain, contract: str, value: int) -> None:
    """Give a contract XRT, as a finalization would."""
    served.ask("person", lambda chain: chain.tokens.transfer(contract, value))


def test_without_jurors_the_account_itself_judges(served: ServedChain) -> None:
    made = served.run_json("validator", "deploy")
    own = served.people["person"].address
    assert (made["keeper"], made["jurors"], made["quorum"]) == (own, [own], 1)
    assert made["gas"] > 500_000
    assert int(made["wei"]) > 0
    jury = served.ask("robot", lambda chain: chain.validators.jury(made["validator"]))
    assert jury is not None
    assert (jury.keeper, jury.jurors, jury.quorum) == (own, (own,), 1)


@pytest.mark.parametrize(("options", "quorum"), [((), 2), (("--quorum", "3"), 3), (("--quorum", "1"), 1)])
def test_the_quorum_is_more_than_half_unless_it_is_given(
    served: ServedChain, options: tuple[str, ...], quorum: int
) -> None:
    roles = ("provider", "robot", "person")
    named = [word for role in roles for word in ("--juror", served.people[role].address)]
    made = served.run_json("validator", "deploy", *named, *options)
    assert made["quorum"] == quorum
    assert made["jurors"] == ascending(served, *roles)


def test_deploying_says_what_to_do_next(served: ServedChain) -> None:
    jurors = ascending(served, "provider", "robot")
    named = [word for juror in jurors for word in ("--juror", juror)]
    said = served.aira("validator", "deploy", *named).stdout
    facts = columns(said)
    address = facts["validator"]
    assert facts["quorum"] == "2 of 2 jurors"
    assert facts["jurors"] == jurors[0]
    assert f"\n{'':11}{jurors[1]}\n" in said
    assert facts["gas"].endswith(" ETH")
    for command in ("validator --validator-contract", "demand --validator", "validator collect"):
        assert f"aira {command} {address}" in said


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--quorum", "0"), "invalid-jury"),
        (("--quorum", "2"), "invalid-jury"),
        (("--juror", "nobody"), InvalidAddress.code),
        (tuple(word for number in range(1, 9) for word in ("--juror", f"0x{number:040x}")), "invalid-jury"),
        (("--juror", f"0x{1:040x}", "--juror", f"0x{1:040x}"), "invalid-jury"),
    ],
)
def test_what_is_no_jury_is_one_clear_line(served: ServedChain, arguments: tuple[str, ...], code: str) -> None:
    refused(served.aira("validator", "deploy", *arguments), InputError, code=code)


def test_the_keeper_collects_all_or_a_part(served: ServedChain) -> None:
    contract = served.run_json("validator", "deploy")["validator"]
    pay(served, contract, 3 * XRT)
    before = served.ask("person", lambda chain: chain.tokens.balance())
    part = served.run_json("validator", "collect", contract, "--value", "0.5")
    assert (part["collected"], part["left"]) == (str(XRT // 2), str(5 * XRT // 2))
    said = columns(served.aira("validator", "collect", AIRA_VALIDATOR_CONTRACT=contract).stdout)
    assert (said["collected"], said["left"]) == ("2.5 XRT", "0 XRT")
    assert served.ask("person", lambda chain: chain.tokens.balance()) == before + 3 * XRT
    assert refused(served.aira("validator", "collect", contract), ChainError, code="no-fees")


def test_what_can_not_be_collected_is_one_clear_line(served: ServedChain) -> None:
    contract = served.run_json("validator", "deploy")["validator"]
    pay(served, contract, XRT)
    assert "deployed" in refused(served.aira("validator", "collect", contract, by="robot"), Reverted)
    assert refused(served.aira("validator", "collect", contract, "--value", "2"), InsufficientTokens)
    assert refused(served.aira("validator", "collect", contract, "--value", "much"), InvalidAmount)
    assert refused(served.aira("validator", "collect", served.deployment.factory), ChainError, code="not-a-jury")
    assert refused(served.aira("validator", "collect"), "invalid-options")

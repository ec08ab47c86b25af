"""What legacy clients rely on: selectors, events, and errors that any of the contracts can pass on."""

from __future__ import annotations

from typing import Any

import pytest

from schemas import keccak256
from tests.support.contracts.suite import artifact

LEGACY = [
    ("Lighthouse", "createLiability(bytes,bytes)", "d2b962f2"),
    ("Factory", "createLighthouse(uint256,uint256,string)", "4d5b85f1"),
    ("Lighthouse", "refill(uint256)", "ca9d07ba"),
    ("Lighthouse", "withdraw(uint256)", "2e1a7d4d"),
    ("Lighthouse", "finalizeLiability(address,bytes,bool,bytes)", "563e52d5"),
    ("Lighthouse", "to(address,bytes)", "af0bdb38"),
    ("Liability", "finalize(bytes,bool,bytes,bool)", "c5213e31"),
    ("Factory", "nonceOf(address)", "ed2a2d64"),
    ("Factory", "gasConsumedOf(address)", "99d5bae1"),
    ("Factory", "gasUtilizing(address)", "afecd5e4"),
]

EVENTS = [
    ("Factory", "NewLiability(address indexed)"),
    ("Factory", "NewLighthouse(address indexed,string)"),
    ("Factory", "HashConsumed(bytes32 indexed)"),
    ("Liability", "Finalized(bool indexed,bytes)"),
    ("Lighthouse", "Online(address indexed)"),
    ("Lighthouse", "Offline(address indexed)"),
    ("Lighthouse", "Current(address indexed,uint256 indexed)"),
]


def entries(name: str, kind: str) -> list[dict[str, Any]]:
    """The entries of one kind in a contract's ABI."""
    return [entry for entry in artifact(name)["abi"] if entry["type"] == kind]


def signature(entry: dict[str, Any]) -> str:
    """`name(type,type)`, with the word `indexed` where it is."""
    marks = (member["type"] + (" indexed" if member.get("indexed") else "") for member in entry["inputs"])
    return f"{entry['name']}({','.join(marks)})"


@pytest.mark.parametrize(("contract", "function", "selector"), LEGACY)
def test_legacy_functions_keep_their_selectors(contract: str, function: str, selector: str) -> None:
    assert function in {signature(entry) for entry in entries(contract, "function")}
    assert keccak256(function.encode())[:4].hex() == selector


@pytest.mark.parametrize(("contract", "event"), EVENTS)
def test_legacy_events_keep_their_shape(contract: str, event: str) -> None:
    assert event in {signature(entry) for entry in entries(contract, "event")}


def test_the_factory_interface_includes_errors_of_lighthouse_and_liability() -> None:
    errors = [{signature(entry) for entry in entries(name, "error")} for name in ("Factory", "Lighthouse", "Liability")]
    assert errors[1] <= errors[0]
    assert errors[2] <= errors[0]
    assert "CostMismatch()" in errors[1] & errors[2]
    assert "ERC20InsufficientAllowance(address,uint256,uint256)" in errors[1] & errors[2]


def test_code_fits_into_a_contract() -> None:
    for name in ("ENSRegistry", "Resolver", "XRT", "Factory", "Lighthouse", "Liability"):
        assert len(bytes.fromhex(artifact(name)["deployedBytecode"][2:])) <= 24_576
        assert len(bytes.fromhex(artifact(name)["bytecode"][2:])) <= 49_152

"""Decoding reverts, as several nodes report them."""

from __future__ import annotations

from typing import Any

import pytest
from eth_abi.abi import encode

from mesh.chain.answers import RpcFailure, custom_errors, decode_revert, explain
from mesh.chain.errors import REVERT_HINTS
from schemas import keccak256

ADDRESS = "0x00000000219ab540356cBB839Cbe05303d7705Fa"
NOT_A_PROVIDER = keccak256(b"NotAProvider(address)")[:4] + encode(["address"], [ADDRESS])


@pytest.mark.parametrize(
    "error",
    [
        {"code": 3, "message": "execution reverted", "data": "0x" + NOT_A_PROVIDER.hex()},
        {"code": 3, "message": "execution reverted: custom error 0x…", "data": "0x" + NOT_A_PROVIDER.hex()},
        {"code": -32603, "message": "Error: VM reverted", "data": {"message": "", "data": "0x" + NOT_A_PROVIDER.hex()}},
        {"code": -32015, "message": "VM execution error.", "data": "Reverted 0x" + NOT_A_PROVIDER.hex()},
    ],
    ids=["geth", "anvil", "hardhat", "parity"],
)
def test_custom_errors_are_found_wherever_nodes_put_them(error: dict[str, Any]) -> None:
    reverted = decode_revert(RpcFailure(**error))
    assert reverted is not None
    assert (reverted.reason, reverted.arguments) == ("NotAProvider", (ADDRESS,))
    assert str(reverted) == f"the contract refused: NotAProvider ({ADDRESS})"
    assert reverted.hint == REVERT_HINTS["NotAProvider"]


def test_every_hint_is_for_an_error_of_the_contracts() -> None:
    known = {name for name, _ in custom_errors().values()}
    assert REVERT_HINTS.keys() - known == {"OutOfGas"}, "which no contract says"


@pytest.mark.parametrize(
    "error",
    [
        {"code": -32000, "message": "nonce too low"},
        {"code": -32000, "message": "insufficient funds for gas * price + value"},
        {"code": -32601, "message": "the method does not exist"},
        {"code": -32000, "message": "this node has reverted to read-only mode"},
        {"code": -32000, "message": "reverted to an earlier block, try again"},
        {"code": -32000, "message": "the block was reverted by a reorganisation", "data": {"reverted": True}},
        {"code": -32603, "message": "can't revert state snapshot"},
        {},
    ],
)
def test_other_errors_are_not_reverts(error: dict[str, Any]) -> None:
    assert decode_revert(RpcFailure(**error)) is None


@pytest.mark.parametrize(
    "error",
    [
        {"code": 3, "message": "execution reverted"},
        {"code": -32000, "message": "execution reverted"},
        {"code": -32000, "message": "evm: execution reverted"},
        {"code": -32000, "message": "Execution reverted"},
        {"code": -32000, "message": "VM Exception while processing transaction: revert"},
        {"code": -32603, "message": "Error: Transaction reverted without a reason string"},
        {"code": -32603, "message": "Error: VM Exception while processing transaction: reverted with an unrecognized"},
        {"code": -32008, "message": "CONTRACT_REVERT_EXECUTED"},
        {"code": -32000, "message": "REVERT opcode executed"},
        {"code": -32015, "message": "VM execution error.", "data": "Reverted 0x"},
        {"code": -32015, "message": "VM execution error.", "data": "revert"},
    ],
)
def test_reverts_without_data_are_known_by_the_words_of_nodes(error: dict[str, Any]) -> None:
    reverted = decode_revert(RpcFailure(**error))
    assert reverted is not None
    assert reverted.reason == ""


def test_a_plain_revert_gives_its_text() -> None:
    assert explain(bytes.fromhex("08c379a0") + encode(["string"], ["too late"])).reason == "too late"


def test_without_data_the_reason_is_taken_from_the_message() -> None:
    reverted = decode_revert(RpcFailure(3, "execution reverted: too late"))
    assert reverted is not None
    assert reverted.reason == "too late"


def test_a_panic_has_its_code() -> None:
    panic = explain(bytes.fromhex("4e487b71") + encode(["uint256"], [0x11]))
    assert (panic.reason, panic.arguments) == ("Panic", (0x11,))


@pytest.mark.parametrize("data", [b"", b"\1", b"\xde\xad\xbe\xef", NOT_A_PROVIDER[:10], bytes.fromhex("08c379a0ff")])
def test_unknown_revert_data_is_kept(data: bytes) -> None:
    reverted = explain(data)
    assert (reverted.reason, reverted.arguments, reverted.data) == ("", (), data)


def test_every_error_of_the_contracts_is_known() -> None:
    names = {name for name, _ in custom_errors().values()}
    assert {"CostMismatch", "ERC20InsufficientAllowance", "OrderUsed", "NotYourTurn", "AlreadyFinalized"} <= names

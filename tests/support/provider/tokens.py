"""Malicious tokens as bytecode: every call has the same effect, or every one that is no look at balances."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain import TransactionSender
from schemas import keccak256

if TYPE_CHECKING:
    from mesh.chain import Chain

BURNS_ALL_GAS = bytes.fromhex("fe")
"""INVALID, which uses up all gas of the call."""


def readable(code: bytes) -> bytes:
    """A token of which everybody has 2^256 - 1, and that does what `code` does when it is to pay."""
    # CALLDATASIZE, PUSH1 100, GT, ISZERO, PUSH1 19, JUMPI, PUSH1 0, NOT, PUSH1 0, MSTORE, PUSH1 32, PUSH1 0, RETURN
    return bytes.fromhex("366064111560135760001960005260206000f3" + "5b") + code


def refuses_with(error: str) -> bytes:
    """Code that reverts with a custom error (its signature) and two words of zeros."""
    selector = keccak256(error.encode())[:4]
    # PUSH4 selector, PUSH1 224, SHL, PUSH1 0, MSTORE, PUSH1 68, PUSH1 0, REVERT
    return b"\x63" + selector + bytes.fromhex("60e01b60005260446000fd")


def says(text: bytes) -> bytes:
    """Code that reverts with a text of up to 32 bytes, as `require(false, text)` does."""
    words = bytes.fromhex("08c379a0") + (32).to_bytes(32, "big") + len(text).to_bytes(32, "big") + text.ljust(32, b"\0")
    # PUSH1 size, PUSH1 size, CODESIZE, SUB (where the words are), PUSH1 0, CODECOPY, PUSH1 size, PUSH1 0, REVERT
    size = len(words)
    return bytes((0x60, size, 0x60, size, 0x38, 0x03, 0x60, 0, 0x39, 0x60, size, 0x60, 0, 0xFD)) + words


async def deploy_token(chain: Chain, code: bytes) -> str:
    """Deploy code, and return its address."""
    # PUSH1 size, DUP1, PUSH1 11, PUSH1 0, CODECOPY, PUSH1 0, RETURN
    creation = bytes((0x60, len(code), 0x80, 0x60, 11, 0x60, 0, 0x39, 0x60, 0, 0xF3)) + code
    assert chain.account is not None
    receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=creation)
    return str(receipt.contract)

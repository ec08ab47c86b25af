"""Malicious tokens as bytecode: every call has the same effect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain import TransactionSender
from schemas import keccak256

if TYPE_CHECKING:
    from mesh.chain import Chain

BURNS_ALL_GAS = bytes.fromhex("fe")
"""INVALID, which uses up all gas of the call."""


def refuses_with(error: str) -> bytes:
    """Code that reverts with a custom error (its signature) and two words of zeros."""
    selector = keccak256(error.encode())[:4]
    # PUSH4 selector, PUSH1 224, SHL, PUSH1 0, MSTORE, PUSH1 68, PUSH1 0, REVERT
    return b"\x63" + selector + bytes.fromhex("60e01b60005260446000fd")


def says(text: bytes) -> bytes:
    """Code that reverts with a text of up to 32 bytes, as `require(false, text)` does."""
    words = bytes.fromhex("08c379a0") + (32).to_bytes(32, "big") + len(text).to_bytes(32, "big") + text.ljust(32, b"\0")
    # PUSH1 size, PUSH1 12 (where the words are), PUSH1 0, CODECOPY, PUSH1 size, PUSH1 0, REVERT
    return bytes((0x60, len(words), 0x60, 12, 0x60, 0, 0x39, 0x60, len(words), 0x60, 0, 0xFD)) + words


async def deploy_token(chain: Chain, code: bytes) -> str:
    """Deploy code, and return its address."""
    # PUSH1 size, DUP1, PUSH1 11, PUSH1 0, CODECOPY, PUSH1 0, RETURN
    creation = bytes((0x60, len(code), 0x80, 0x60, 11, 0x60, 0, 0x39, 0x60, 0, 0xF3)) + code
    assert chain.account is not None
    receipt = await TransactionSender(chain.node, chain.account).send(to=None, data=creation)
    return str(receipt.contract)

"""Decoding why a contract reverted: from a node's JSON-RPC error to `Reverted`.

Revert data is the 4-byte selector of an error and its ABI-encoded arguments: one of our custom errors, `Error(string)`
or `Panic(uint256)`. Geth, anvil and the embedded chain put it into the `data` of the JSON-RPC error, others deeper.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final

from mesh.chain.abi import MalformedAbi, decode
from mesh.chain.answers import LONGEST_TEXT
from mesh.chain.artifacts import NAMES, load_artifact, signature_of
from mesh.chain.errors import Reverted
from schemas import keccak256

if TYPE_CHECKING:
    from mesh.chain.answers import RpcFailure

REVERTED: Final = 3
"""The JSON-RPC code that geth and anvil give to a call which the contract reverted."""

PLAIN: Final = bytes.fromhex("08c379a0")
"""Selector of `Error(string)`, a revert with a text."""

PANIC: Final = bytes.fromhex("4e487b71")
"""Selector of `Panic(uint256)`, a failed assertion of the compiler."""


def decode_revert(failure: RpcFailure) -> Reverted | None:
    """The revert in a node's JSON-RPC error; None if it is another kind of error."""
    data = _revert_data(failure.data)
    if data is None and failure.code != REVERTED and "revert" not in failure.message.lower():
        return None
    return explain(data or b"", message=failure.message)


def explain(data: bytes, *, message: str = "") -> Reverted:
    """The revert in revert data; `message` is the node's, for a revert without data."""
    selector, body = data[:4], data[4:]
    try:
        if selector == PLAIN:
            return Reverted(str(decode(["string"], body)[0])[:LONGEST_TEXT], data=data)
        if selector == PANIC:
            return Reverted("Panic", arguments=decode(["uint256"], body), data=data)
        if selector in custom_errors():
            name, types = custom_errors()[selector]
            return Reverted(name, arguments=decode(types, body), data=data)
    except MalformedAbi:
        return Reverted("", data=data)
    _, _, reason = message.partition("execution reverted: ")
    return Reverted("" if data else reason, data=data)


@cache
def custom_errors() -> dict[bytes, tuple[str, list[str]]]:
    """Name and argument types of every custom error of our contracts, by selector."""
    errors = (entry for name in NAMES for entry in load_artifact(name).abi if entry["type"] == "error")
    return {
        keccak256(signature_of(entry).encode())[:4]: (entry["name"], [member["type"] for member in entry["inputs"]])
        for entry in errors
    }


def _revert_data(data: object) -> bytes | None:
    """The revert data, which nodes put in different places; None if there is none."""
    if isinstance(data, dict):
        data = data.get("data") or data.get("result")
    if not isinstance(data, str):
        return None
    _, found, digits = data.rpartition("0x")
    try:
        return bytes.fromhex(digits) if found else None
    except ValueError:
        return None

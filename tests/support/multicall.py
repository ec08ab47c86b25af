"""The code that makes many calls, for nodes that imitate it: what it is asked, and what it returns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain._abi import decode, load_artifact

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain._node import Call


def decode_calls(code: bytes) -> list[Call] | None:
    """The calls that `encode_calls` encoded; None for other code."""
    known = load_artifact("Multicall").bytecode
    if not code.startswith(known):
        return None
    packed, at = decode(["uint256", "uint256", "bytes"], code[len(known) :])[2], 0
    calls: list[Call] = []
    while at < len(packed):
        data = at + 22
        end = data + int.from_bytes(packed[at + 20 : data])
        calls.append(("0x" + packed[at : at + 20].hex(), packed[data:end]))
        at = end
    return calls


def encode_answers(answers: Sequence[bytes | None]) -> bytes:
    """What the code returns: of each call what it returned, or None if it failed."""
    return b"".join([bytes([one is not None]) + len(one or b"").to_bytes(2) + (one or b"") for one in answers])

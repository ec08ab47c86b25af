"""Whether the contracts on a chain are this project's: by their code, whatever they say of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.chain.artifacts import load_artifact

if TYPE_CHECKING:
    from mesh.chain.client import Chain

PUSH32: Final = 0x7F
WORD: Final = 32
"""Bytes of an immutable, which the constructor writes into the code behind a `PUSH32`."""


async def is_ours(chain: Chain) -> bool:
    """Whether factory and token have the code that this project's sources compile to. Raises `NodeUnreachable`."""
    for name, address in (("Factory", chain.factory), ("XRT", chain.xrt)):
        code = await chain.node.code(address)
        if not is_code_of(name, code):
            return False
    return True


def is_code_of(name: str, code: bytes) -> bool:
    """Whether deployed code is that of an artifact, its immutables aside."""
    runtime = load_artifact(name).runtime
    if len(code) != len(runtime):
        return False
    at = 0
    while at < len(runtime):
        if code[at] == runtime[at]:
            at += 1
        elif _is_immutable(runtime, at):
            at = runtime.rindex(PUSH32, 0, at + 1) + 1 + WORD
        else:
            return False
    return True


def _is_immutable(runtime: bytes, at: int) -> bool:
    """Whether a byte is in a word of zeros that is pushed: the place of an immutable."""
    start = runtime.rfind(PUSH32, max(0, at - WORD), at) + 1
    return start > 0 and at < start + WORD and not any(runtime[start : start + WORD])

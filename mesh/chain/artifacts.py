"""The built contracts (package data `artifacts/NAME.json`), and recognising their code on a chain."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

NAMES: Final = ("ENSRegistry", "Resolver", "XRT", "Factory", "Lighthouse", "Liability", "Jury")

PUSH32: Final = 0x7F
WORD: Final = 32
"""Bytes of an immutable, which the constructor writes into the code behind a `PUSH32`."""


@dataclass(frozen=True, slots=True)
class Artifact:
    """A built contract: ABI, creation code, and deployed code with zeros for its immutables."""

    name: str
    abi: tuple[dict[str, Any], ...]
    bytecode: bytes
    runtime: bytes


@cache
def load_artifact(name: str) -> Artifact:
    """The artifact of one of `NAMES`."""
    text = resources.files("mesh.chain").joinpath("artifacts", f"{name}.json").read_text(encoding="utf-8")
    content = json.loads(text)
    bytecode = bytes.fromhex(content["bytecode"].removeprefix("0x"))
    runtime = bytes.fromhex(content["deployedBytecode"].removeprefix("0x"))
    return Artifact(name=name, abi=tuple(content["abi"]), bytecode=bytecode, runtime=runtime)


def signature_of(entry: Mapping[str, Any]) -> str:
    """The canonical signature of a function, event or error of an ABI: `name(type,type)`."""
    return f"{entry['name']}({','.join(member['type'] for member in entry['inputs'])})"


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

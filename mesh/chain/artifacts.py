"""The built contracts, as package data: `artifacts/NAME.json`, made by the contracts' own build."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

NAMES: Final = ("ENSRegistry", "Resolver", "XRT", "Factory", "Lighthouse", "Liability")


@dataclass(frozen=True, slots=True)
class Artifact:
    """A built contract: its ABI, the code that deploys it, and the code that is deployed, its immutables zero."""

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


def signature_of(entry: dict[str, Any]) -> str:
    """The canonical signature of a function, event or error of an ABI: `name(type,type)`."""
    return f"{entry['name']}({','.join(member['type'] for member in entry['inputs'])})"

"""Calls, events and errors of our contracts as the EVM has them: words, selectors and topics from the ABIs.

Addresses are 20 bytes, numbers are ints, `bytes` and `bytesN` are bytes, strings are their UTF-8 bytes.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import mesh.chain
from schemas import keccak256

if TYPE_CHECKING:
    from collections.abc import Sequence

WORD: Final = 32
MOST: Final = 2**64 - 1
"""The largest offset and length that Solidity's decoder takes."""
DYNAMIC: Final = ("bytes", "string")
PANIC: Final = bytes.fromhex("4e487b71")
OVERFLOW: Final = 0x11
ARTIFACTS: Final = Path(mesh.chain.__file__).parent / "artifacts"
FOR_TESTS: Final = Path(__file__).parents[1] / "contracts" / "artifacts"


class ModelRevert(Exception):
    """A contract undoes the call. `data` says why."""

    def __init__(self, data: bytes = b"") -> None:
        super().__init__(data.hex())
        self.data = data


class ModelFunction(NamedTuple):
    """A function of an ABI."""

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class ModelEvent(NamedTuple):
    """An event of an ABI: its first topic, the types of what is indexed, then of the rest."""

    topic: bytes
    indexed: tuple[bool, ...]
    types: tuple[str, ...]


@cache
def artifact(name: str) -> dict[str, Any]:
    """A built contract as it is in its file, of the suite or of those that only tests use."""
    path = ARTIFACTS / f"{name}.json"
    found: dict[str, Any] = json.loads((path if path.exists() else FOR_TESTS / path.name).read_text(encoding="utf-8"))
    return found


@cache
def functions(name: str) -> dict[bytes, ModelFunction]:
    """The functions of a contract by selector."""
    found = {}
    for entry in artifact(name)["abi"]:
        if entry["type"] == "function":
            outputs = tuple(output["type"] for output in entry["outputs"])
            found[_hash(entry)[:4]] = ModelFunction(entry["name"], _types(entry), outputs)
    return found


def _entries(kind: str) -> list[dict[str, Any]]:
    names = sorted(path.stem for path in ARTIFACTS.glob("*.json"))
    return [entry for name in names for entry in artifact(name)["abi"] if entry["type"] == kind]


@cache
def _event(name: str, types: int) -> ModelEvent:
    for entry in _entries("event"):
        if entry["name"] == name and len(entry["inputs"]) == types:
            return ModelEvent(_hash(entry), tuple(member["indexed"] for member in entry["inputs"]), _types(entry))
    raise LookupError(name)


@cache
def _error(name: str) -> tuple[bytes, tuple[str, ...]]:
    return next((_hash(entry)[:4], _types(entry)) for entry in _entries("error") if entry["name"] == name)


def _types(entry: dict[str, Any]) -> tuple[str, ...]:
    return tuple(member["type"] for member in entry["inputs"])


def _hash(entry: dict[str, Any]) -> bytes:
    return keccak256(f"{entry['name']}({','.join(_types(entry))})".encode())


def refused(name: str, *values: Any) -> ModelRevert:
    """A custom error."""
    selector, types = _error(name)
    return ModelRevert(selector + encode(types, values))


def checked(value: int) -> int:
    """A sum or a product as Solidity has it: it panics beyond 256 bits."""
    if not 0 <= value < 1 << 256:
        raise ModelRevert(PANIC + word(OVERFLOW))
    return value


def word(value: int | bytes) -> bytes:
    """A static value as a word."""
    if isinstance(value, int):
        return value.to_bytes(WORD, "big")
    return value.rjust(WORD, b"\0") if len(value) == 20 else value.ljust(WORD, b"\0")


def encode(types: Sequence[str], values: Sequence[Any]) -> bytes:
    """The canonical encoding."""
    head, tail = [], b""
    for kind, value in zip(types, values, strict=True):
        if kind in DYNAMIC or kind.endswith("[]"):
            head.append(word(WORD * len(types) + len(tail)))
            padded = (
                b"".join(map(word, value)) if kind.endswith("[]") else value.ljust(-(-len(value) // WORD) * WORD, b"\0")
            )
            tail += word(len(value)) + padded
        else:
            head.append(word(value))
    return b"".join(head) + tail


def decode(types: Sequence[str], data: bytes) -> list[Any]:
    """What Solidity decodes; it reverts without a reason what it does not accept."""
    if len(data) < WORD * len(types):
        raise ModelRevert
    found: list[Any] = []
    for at, kind in enumerate(types):
        raw = data[WORD * at : WORD * at + WORD]
        if kind == "address[]":
            start = int.from_bytes(raw, "big") + WORD
            count = int.from_bytes(data[start - WORD : start], "big")
            found.append([data[at + 12 : at + WORD] for at in range(start, start + WORD * count, WORD)])
        elif kind in DYNAMIC:
            found.append(_dynamic(data, int.from_bytes(raw, "big")))
        elif kind.startswith("bytes"):
            size = int(kind[5:])
            if any(raw[size:]):
                raise ModelRevert
            found.append(raw[:size])
        elif kind == "address":
            if any(raw[:12]):
                raise ModelRevert
            found.append(raw[12:])
        else:
            number = int.from_bytes(raw, "big")
            if number >> (1 if kind == "bool" else int(kind[4:])):
                raise ModelRevert
            found.append(bool(number) if kind == "bool" else number)
    return found


def _dynamic(data: bytes, offset: int) -> bytes:
    if offset > MOST or offset + WORD - 1 >= len(data):
        raise ModelRevert
    size = int.from_bytes(data[offset : offset + WORD].ljust(WORD, b"\0"), "big")
    if size > MOST or offset + WORD + size > len(data):
        raise ModelRevert
    return data[offset + WORD : offset + WORD + size]


def log_of(name: str, values: Sequence[Any]) -> tuple[list[bytes], bytes]:
    """The topics and the data of an event."""
    event = _event(name, len(values))
    rows = list(zip(event.indexed, event.types, values, strict=True))
    topics = [event.topic, *(word(value) for indexed, _, value in rows if indexed)]
    rest = [(kind, value) for indexed, kind, value in rows if not indexed]
    return topics, encode([kind for kind, _ in rest], [value for _, value in rest])

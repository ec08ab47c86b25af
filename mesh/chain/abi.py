"""The ABI of contracts: encoding what functions take, decoding what they return and log, and calls of functions.

It knows the types that our contracts have: `uintN`, `bool`, `address`, `bytesN`, `bytes`, `string`, lists and tuples
of them, but no tuple without `bytes`, `string` or a list in it. Decoding is strict: padding must be zero.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from mesh.chain.artifacts import load_artifact, signature_of
from schemas import keccak256
from schemas.address import address_bytes, checksum_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    Reader: TypeAlias = Callable[[bytes, int], Any]
    Writer: TypeAlias = Callable[[Any], bytes]

WORD: Final = 32
SELECTOR: Final = 4
NO_PADDING: Final = bytes(WORD)


class MalformedAbi(ValueError):
    """Bytes are not the encoding of values of the expected types."""


class AbiType(NamedTuple):
    """How a type is read at a place in data, and written. A dynamic one is written behind a word with its place."""

    read: Reader
    write: Writer
    is_dynamic: bool


def decode(types: Sequence[str], data: bytes) -> tuple[Any, ...]:
    """The values in ABI-encoded data; addresses are EIP-55. Raises `MalformedAbi`."""
    values: tuple[Any, ...] = _sequence(tuple(types)).read(data, 0)
    return values


def encode(types: Sequence[str], values: Sequence[Any]) -> bytes:
    """The ABI encoding of values. Raises `ValueError`, `InvalidAddress` for one that does not fit its type."""
    return _sequence(tuple(types)).write(values)


@cache
def _type(name: str) -> AbiType:
    if name.endswith("[]"):
        return _list(_type(name[:-2]))
    if name.startswith("("):
        return _sequence(tuple(name[1:-1].split(",")))
    if name.startswith("uint"):
        return _uint(int(name[4:]))
    if name in ("bytes", "string"):
        return _text(is_text=name == "string")
    if name.startswith("bytes"):
        return _fixed(int(name[5:]))
    return {"bool": AbiType(_read_bool, _write_bool, False), "address": AbiType(_read_address, _write_address, False)}[
        name
    ]


@cache
def _sequence(names: tuple[str, ...]) -> AbiType:
    members = [_type(name) for name in names]
    places = [(number * WORD, member) for number, member in enumerate(members)]

    def read(data: bytes, at: int) -> tuple[Any, ...]:
        return tuple(
            [
                member.read(data, _pointer(data, at, place, len(names)) if member.is_dynamic else at + place)
                for place, member in places
            ]
        )

    def write(values: Sequence[Any]) -> bytes:
        if len(values) != len(members):
            raise ValueError(f"{len(values)} values for {', '.join(names)}")
        return _join([member.write(value) for member, value in zip(members, values, strict=True)], members)

    return AbiType(read, write, True)


def _list(element: AbiType) -> AbiType:
    def read(data: bytes, at: int) -> list[Any]:
        count, start = _read_word(data, at), at + WORD
        if count * WORD > len(data) - start:
            raise MalformedAbi(f"a list of {count} values")
        places = range(start, start + count * WORD, WORD)
        if element.is_dynamic:
            return [element.read(data, _pointer(data, start, place - start, count)) for place in places]
        return [element.read(data, place) for place in places]

    def write(values: Sequence[Any]) -> bytes:
        parts = [element.write(value) for value in values]
        return len(parts).to_bytes(WORD) + _join(parts, [element] * len(parts))

    return AbiType(read, write, True)


def _join(parts: list[bytes], members: Sequence[AbiType]) -> bytes:
    """Values one after another: of each dynamic one a word with its place, and the value behind all words."""
    heads, tails, at = [], [], WORD * len(parts)
    for part, member in zip(parts, members, strict=True):
        if member.is_dynamic:
            heads.append(at.to_bytes(WORD))
            tails.append(part)
            at += len(part)
        else:
            heads.append(part)
    return b"".join([*heads, *tails])


def _uint(bits: int) -> AbiType:
    def read(data: bytes, at: int) -> int:
        value = _read_word(data, at)
        if value >> bits:
            raise MalformedAbi(f"more than {bits} bits")
        return value

    def write(value: int) -> bytes:
        if isinstance(value, bool) or value < 0 or value >> bits:
            raise ValueError(f"{value} does not fit uint{bits}")
        return value.to_bytes(WORD)

    return AbiType(read, write, False)


def _fixed(size: int) -> AbiType:
    def read(data: bytes, at: int) -> bytes:
        return _read_padded(data, at, size)

    def write(value: bytes) -> bytes:
        if len(value) != size:
            raise ValueError(f"{len(value)} bytes instead of {size}")
        return value + bytes(WORD - size)

    return AbiType(read, write, False)


def _text(*, is_text: bool) -> AbiType:
    def read(data: bytes, at: int) -> bytes | str:
        found = _read_padded(data, at + WORD, _read_word(data, at))
        try:
            return found.decode() if is_text else found
        except UnicodeDecodeError:
            raise MalformedAbi("a text that is not UTF-8") from None

    def write(value: bytes | str) -> bytes:
        content = value.encode() if isinstance(value, str) else value
        return len(content).to_bytes(WORD) + content + bytes(-len(content) % WORD)

    return AbiType(read, write, True)


def _read_word(data: bytes, at: int) -> int:
    if at + WORD > len(data):
        raise MalformedAbi(f"{len(data)} bytes are too short")
    return int.from_bytes(data[at : at + WORD])


def _pointer(data: bytes, start: int, place: int, heads: int) -> int:
    """Where a dynamic value is: behind the words of all values, which begin at `start`."""
    offset = _read_word(data, start + place)
    if offset < heads * WORD:
        raise MalformedAbi(f"a value at {offset}")
    return start + offset


def _read_padded(data: bytes, at: int, size: int) -> bytes:
    """Bytes at a place, with zeros behind them up to a whole word."""
    end = at + size + -size % WORD
    if end > len(data):
        raise MalformedAbi(f"{len(data)} bytes are too short")
    if data[at + size : end] != NO_PADDING[: -size % WORD]:
        raise MalformedAbi("padding that is not zero")
    return data[at : at + size]


def _read_bool(data: bytes, at: int) -> bool:
    value = _read_word(data, at)
    if value > 1:
        raise MalformedAbi(f"{value} as bool")
    return bool(value)


def _write_bool(value: bool) -> bytes:
    return int(bool(value)).to_bytes(WORD)


def _read_address(data: bytes, at: int) -> str:
    if len(data) < at + WORD or data[at : at + 12] != NO_PADDING[:12]:
        raise MalformedAbi("no address")
    return checksum_address(data[at + 12 : at + WORD])


def _write_address(value: str) -> bytes:
    return bytes(12) + address_bytes(value)


class ContractCall(NamedTuple):
    """A call of a contract's function: of the contract at `address`, with `data`; it returns `outputs` (types)."""

    address: str
    fn_name: str
    data: bytes
    outputs: tuple[str, ...]


class ContractFunction(NamedTuple):
    """A function of an ABI."""

    name: str
    selector: bytes
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def at(self, address: str, *arguments: Any) -> ContractCall:
        """The call of the function of the contract at an address. Raises as `encode`."""
        return ContractCall(address, self.name, self.selector + encode(self.inputs, arguments), self.outputs)


class ContractFunctions:
    """The functions of the contract at `address`: each is called for a `ContractCall`, which asks no node."""

    def __init__(self, address: str, functions: Mapping[str, ContractFunction]) -> None:
        self.address = address
        self._functions = functions

    def __getattr__(self, name: str) -> Callable[..., ContractCall]:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None

    def __getitem__(self, name: str) -> Callable[..., ContractCall]:
        function = self._functions[name]
        return lambda *arguments: function.at(self.address, *arguments)

    def __iter__(self) -> Iterator[ContractFunction]:
        return iter(self._functions.values())


def functions_of(abi: Sequence[Mapping[str, Any]]) -> dict[str, ContractFunction]:
    """The functions of an ABI by name, which no two of them share."""
    return {
        entry["name"]: ContractFunction(
            entry["name"],
            keccak256(signature_of(entry).encode())[:SELECTOR],
            tuple(member["type"] for member in entry["inputs"]),
            tuple(member["type"] for member in entry["outputs"]),
        )
        for entry in abi
        if entry["type"] == "function"
    }


@cache
def our_functions(name: str) -> dict[str, ContractFunction]:
    """The functions of one of our contracts (`artifacts.NAMES`)."""
    return functions_of(load_artifact(name).abi)

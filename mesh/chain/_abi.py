"""The built contracts (package data `artifacts/NAME.json`), calls of their functions, and the ABI coding of values.

The coding is eth_abi's, and strict: padding must be zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from eth_abi.codec import ABICodec
from eth_abi.decoding import AddressDecoder
from eth_abi.exceptions import DecodingError, EncodingError
from eth_abi.registry import registry as default_registry
from eth_utils.abi import function_abi_to_4byte_selector, get_abi_input_types, get_abi_output_types

from schemas.address import checksum_address
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence


NAMES: Final = ("ENSRegistry", "Resolver", "XRT", "Factory", "Lighthouse", "Liability", "Jury")

WORD: Final = 32
"""Bytes of a value in the ABI coding, and of an immutable, which the constructor writes into the code."""


@dataclass(frozen=True, slots=True)
class Artifact:
    """A built contract: ABI, creation code, and deployed code with zeros for its immutables."""

    name: str
    abi: tuple[Any, ...]
    bytecode: bytes
    runtime: bytes
    immutables: tuple[tuple[int, ...], ...]
    """The places of each immutable in the deployed code."""


@cache
def load_artifact(name: str) -> Artifact:
    """The artifact of one of `NAMES`."""
    text = resources.files("mesh.chain").joinpath("artifacts", f"{name}.json").read_text(encoding="utf-8")
    content = decode_json(text)
    bytecode = bytes.fromhex(content["bytecode"].removeprefix("0x"))
    runtime = bytes.fromhex(content["deployedBytecode"].removeprefix("0x"))
    immutables = tuple(map(tuple, content["immutables"]))
    return Artifact(name=name, abi=tuple(content["abi"]), bytecode=bytecode, runtime=runtime, immutables=immutables)


def is_code_of(name: str, code: bytes) -> bool:
    """Whether deployed code is that of an artifact, its immutables aside; each has one value wherever it is used."""
    artifact = load_artifact(name)
    if len(code) != len(artifact.runtime):
        return False
    plain = bytearray(code)
    for places in artifact.immutables:
        if len({code[at : at + WORD] for at in places}) > 1:
            return False
        for at in places:
            plain[at : at + WORD] = bytes(WORD)
    return plain == artifact.runtime


class SpoiledAnswer(ValueError):
    """An answer is not what its method, or its contract, returns. Asking again, or another node, may help."""


class _ChecksumAddress(AddressDecoder):
    decoder_fn = staticmethod(checksum_address)  # type: ignore[assignment]


def _codec() -> ABICodec:
    registry = default_registry.copy()  # type: ignore[no-untyped-call]
    registry.unregister_decoder("address")
    registry.register_decoder("address", _ChecksumAddress)
    return ABICodec(registry)


CODEC: Final = _codec()


def decode(types: Sequence[str], data: bytes) -> tuple[Any, ...]:
    """The values in ABI-encoded data; addresses are EIP-55, lists are tuples. Raises `SpoiledAnswer`."""
    try:
        return CODEC.decode(types, data)
    except (DecodingError, UnicodeDecodeError, OverflowError) as error:
        raise SpoiledAnswer(f"{len(data)} bytes are no {', '.join(types)}: {error}") from None


def encode(types: Sequence[str], values: Sequence[Any]) -> bytes:
    """The ABI encoding of values. Raises `ValueError` for one that does not fit its type."""
    try:
        return CODEC.encode(types, values)
    except EncodingError as error:
        raise ValueError(str(error)) from None


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


def functions_of(abi: Sequence[Any]) -> dict[str, ContractFunction]:
    """The functions of an ABI by name, which no two of them share."""
    return {
        entry["name"]: ContractFunction(
            entry["name"],
            function_abi_to_4byte_selector(entry),
            tuple(get_abi_input_types(entry)),
            tuple(get_abi_output_types(entry)),
        )
        for entry in abi
        if entry["type"] == "function"
    }


@cache
def our_functions(name: str) -> dict[str, ContractFunction]:
    """The functions of one of our contracts (`artifacts.NAMES`)."""
    return functions_of(load_artifact(name).abi)

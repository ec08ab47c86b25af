"""ABI encoding and decoding, compared with the library eth_abi and with web3's calls."""

from __future__ import annotations

from typing import Any

import eth_abi
import pytest
from eth_abi.exceptions import DecodingError
from hypothesis import given
from hypothesis import strategies as st
from web3 import Web3

from mesh.chain.abi import MalformedAbi, decode, encode, our_functions
from mesh.chain.artifacts import NAMES, load_artifact
from schemas.address import checksum_address

ADDRESSES = st.binary(min_size=20, max_size=20).map(checksum_address)
LEAVES: dict[str, st.SearchStrategy[Any]] = {
    "uint256": st.integers(0, 2**256 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "uint8": st.integers(0, 255),
    "bool": st.booleans(),
    "address": ADDRESSES,
    "bytes32": st.binary(min_size=32, max_size=32),
    "bytes4": st.binary(min_size=4, max_size=4),
    "bytes": st.binary(max_size=70),
    "string": st.text(alphabet="aé漢\0", max_size=40),
    "(address,bytes)[]": st.lists(st.tuples(ADDRESSES, st.binary(max_size=40)), max_size=3),
    "(bool,bytes)[]": st.lists(st.tuples(st.booleans(), st.binary(max_size=40)), max_size=3),
}
KINDS = LEAVES | {f"{name}[]": st.lists(LEAVES[name], max_size=4) for name in ("uint256", "address")}


@st.composite
def values(draw: st.DrawFn) -> tuple[list[str], list[Any]]:
    types = draw(st.lists(st.sampled_from(sorted(KINDS)), max_size=5))
    return types, [draw(KINDS[name]) for name in types]


def plain(value: Any) -> Any:
    """Without the differences that don't matter: sequences as tuples, addresses in lower case."""
    if isinstance(value, list | tuple):
        return tuple(map(plain, value))
    return value.lower() if isinstance(value, str) and value.startswith("0x") else value


@given(values())
def test_values_are_encoded_and_decoded_as_by_the_library(given: tuple[list[str], list[Any]]) -> None:
    types, members = given
    encoded = encode(types, members)
    assert encoded == eth_abi.abi.encode(types, members)
    assert plain(decode(types, encoded)) == plain(members)


@given(values(), st.data())
def test_changed_bytes_are_refused_or_decoded_as_by_the_library(
    given: tuple[list[str], list[Any]], data: st.DataObject
) -> None:
    types, members = given
    changed = bytearray(encode(types, members))
    for _ in range(data.draw(st.integers(1, 3))):
        if changed:
            # The last bytes of a word are those that make places and lengths wrong, but not absurd.
            at = data.draw(st.integers(0, len(changed) - 1)) | data.draw(st.sampled_from((0, 31)))
            changed[min(at, len(changed) - 1)] = data.draw(st.integers(0, 255))
    changed = changed[: data.draw(st.integers(0, len(changed)))] if data.draw(st.booleans()) else changed
    try:
        expected: Any = eth_abi.abi.decode(types, bytes(changed))
    except (DecodingError, UnicodeDecodeError, OverflowError):
        with pytest.raises(MalformedAbi):
            decode(types, bytes(changed))
        return
    try:
        found = decode(types, bytes(changed))
    except MalformedAbi:
        assert encode(types, expected) != changed  # values that overlap
    else:
        assert plain(found) == plain(expected)


@pytest.mark.parametrize(
    ("kind", "value"),
    [("uint8", 256), ("uint256", -1), ("uint256", True), ("bytes32", b"1"), ("address", "0x12"), ("uint256[]", [-1])],
)
def test_a_value_that_does_not_fit_its_type_is_not_encoded(kind: str, value: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        encode([kind], [value])


def test_a_list_can_not_claim_more_values_than_there_are_bytes() -> None:
    for count in (2**255, 2, 2**64):
        with pytest.raises(MalformedAbi):
            decode(["uint256[]"], (32).to_bytes(32) + count.to_bytes(32) + bytes(32))


EXAMPLES: dict[str, Any] = {
    "uint256": 7,
    "uint64": 8,
    "uint8": 9,
    "bool": True,
    "address": checksum_address(bytes(range(20))),
    "bytes32": bytes(range(32)),
    "bytes4": b"1234",
    "bytes": b"some bytes",
    "string": "text",
    "uint256[]": [1, 2],
    "address[]": [checksum_address(bytes(range(20)))],
}


@pytest.mark.parametrize("name", NAMES)
def test_calls_of_our_functions_are_those_of_web3(name: str) -> None:
    address = checksum_address(b"\x11" * 20)
    contract = Web3().eth.contract(address, abi=load_artifact(name).abi)  # type: ignore[call-overload]
    assert our_functions(name)
    for function in our_functions(name).values():
        arguments = [EXAMPLES[kind] for kind in function.inputs]
        call = function.at(address, *arguments)
        assert "0x" + call.data.hex() == contract.encode_abi(function.name, arguments)
        assert call.address == address

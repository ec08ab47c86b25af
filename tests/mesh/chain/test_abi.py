"""ABI encoding and decoding, and calls of functions, compared with web3's."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from web3 import Web3

from mesh.chain._abi import NAMES, SpoiledAnswer, decode, encode, load_artifact, our_functions
from schemas.address import checksum_address

OUTPUTS = sorted({function.outputs for name in NAMES for function in our_functions(name).values() if function.outputs})


@given(
    st.sampled_from(OUTPUTS),
    st.lists(st.integers(0, 200) | st.integers(0, 2**256 - 1), max_size=12),
    st.integers(0, 31),
)
def test_any_bytes_are_values_of_the_types_or_malformed(types: tuple[str, ...], words: list[int], cut: int) -> None:
    data = b"".join(word.to_bytes(32) for word in words)
    with suppress(SpoiledAnswer):
        values = decode(types, data[: max(len(data) - cut, 0)])
        assert len(values) == len(types)


def test_addresses_are_decoded_with_their_checksums() -> None:
    address = checksum_address(bytes(range(20)))
    encoded = encode(["address", "address[]"], [address, [address]])
    assert decode(["address", "address[]"], encoded) == (address, (address,))


@pytest.mark.parametrize(
    ("kind", "data"), [("bool", b"\2"), ("address", bytes([1]) + bytes(20)), ("bytes4", b"1" + bytes(26) + b"12345")]
)
def test_padding_must_be_zero(kind: str, data: bytes) -> None:
    with pytest.raises(SpoiledAnswer):
        decode([kind], data.rjust(32, b"\0"))


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("uint8", 256),
        ("uint256", -1),
        ("uint256", True),
        ("bytes32", bytes(33)),
        ("address", "0x12"),
        ("uint256[]", [-1]),
    ],
)
def test_a_value_that_does_not_fit_its_type_is_not_encoded(kind: str, value: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        encode([kind], [value])


def test_a_list_can_not_claim_more_values_than_there_are_bytes() -> None:
    for count in (2**255, 2, 2**64):
        with pytest.raises(SpoiledAnswer):
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

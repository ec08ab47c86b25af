"""Addresses, and the ENS names that may replace them."""

from __future__ import annotations

from contextlib import suppress

import pytest
from eth_utils.address import to_checksum_address
from hypothesis import given
from hypothesis import strategies as st

from schemas import (
    ZERO_ADDRESS,
    InvalidAddress,
    address_bytes,
    checksum_address,
    is_ens_name,
    keccak256,
    parse_address,
    parse_address_or_name,
)

# The examples of EIP-55.
EIP_55 = (
    "0x52908400098527886E0F7030069857D2E4169EE7",
    "0x8617E340B3D01FA5F11F306F4090FD50E238070D",
    "0xde709f2102306220921060314715629080e2fb77",
    "0x27b1fdb04752bbc536007a920d24acb045561c26",
    "0x5aAeb6053F3E94C9b9A09f33669435E7Ef1BeAed",
    "0xfB6916095ca1df60bB79Ce92cE3Ea74c37c5d359",
    "0xdbF03B407c01E7cD3CBea99509d93f8DDDC8C6FB",
    "0xD1220A0cf47c7B9Be7A2E6BA89F429762e7b9aDb",
)


def test_keccak_is_that_of_ethereum() -> None:
    assert keccak256(b"").hex() == "c5d2460186f7233c927e7db2dcc703c0e500b653ca82273b7bfad8045d85a470"


@pytest.mark.parametrize("text", EIP_55)
def test_examples_of_eip_55(text: str) -> None:
    assert checksum_address(bytes.fromhex(text[2:])) == text
    assert parse_address(text) == parse_address(text.lower()) == parse_address("0x" + text[2:].upper()) == text


@given(st.binary(min_size=20, max_size=20))
def test_checksum_is_that_of_an_independent_implementation(raw: bytes) -> None:
    text = checksum_address(raw)
    assert text == to_checksum_address(raw)
    assert address_bytes(text) == address_bytes(text.lower()) == raw


@given(st.binary(min_size=20, max_size=20), st.integers(2, 41))
def test_one_letter_in_the_wrong_case_is_refused(raw: bytes, position: int) -> None:
    text = checksum_address(raw)
    spoiled = text[:position] + text[position].swapcase() + text[position + 1 :]
    if spoiled in (text, text.lower(), "0x" + text[2:].upper()):
        return
    with pytest.raises(InvalidAddress) as caught:
        parse_address(spoiled)
    assert "EIP-55" in caught.value.why
    assert caught.value.text == spoiled


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0x",
        EIP_55[0][2:],
        EIP_55[0] + "0",
        EIP_55[0][:-1],
        "0X" + EIP_55[0][2:],
        "0x" + "g" * 40,
        "0x" + " " * 40,
        "0x" + "  " + "1" * 38,
        "0x" + "1" * 39 + "\n",
        "0x" + "\u0661" * 40,
        "airalab.eth",
    ],
)
def test_invalid_addresses_are_refused(text: str) -> None:
    for function in (parse_address, address_bytes):
        with pytest.raises(InvalidAddress) as caught:
            function(text)
        assert caught.value.text == text


@given(st.text(max_size=60))
def test_any_text_is_an_address_or_raises_invalid_address(text: str) -> None:
    assert not is_ens_name(text) or "." in text
    with suppress(InvalidAddress):
        parse_address_or_name(text)


def test_address_has_20_bytes() -> None:
    assert checksum_address(bytes(20)) == ZERO_ADDRESS
    for size in (0, 19, 21, 32):
        with pytest.raises(InvalidAddress):
            checksum_address(bytes(size))


@pytest.mark.parametrize(
    "text", ["airalab.lighthouse.3.robonomics.eth", "a.eth", "xrt.sid", "x-1_y.test", "UPPER.Eth", "a" * 251 + ".eth"]
)
def test_names(text: str) -> None:
    assert is_ens_name(text)
    assert parse_address_or_name(text) == text.lower()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "eth",
        ".eth",
        "a..eth",
        "a.com",
        "a b.eth",
        "a*.eth",
        "a/b.eth",
        "a.eth.",
        "a\n.eth",
        "a\0.eth",
        "\u212a.eth",
        "é.eth",
        "a" * 252 + ".eth",
    ],
)
def test_texts_that_are_not_ens_names(text: str) -> None:
    assert not is_ens_name(text)
    with pytest.raises(InvalidAddress):
        parse_address_or_name(text)


def test_an_address_or_a_name_is_parsed() -> None:
    assert parse_address_or_name(EIP_55[0].lower()) == EIP_55[0]

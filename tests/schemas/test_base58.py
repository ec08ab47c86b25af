"""Base58."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas import InputError, base58

# Known pairs, from the tests of Bitcoin.
PAIRS = (
    ("", ""),
    ("61", "2g"),
    ("626262", "a3gV"),
    ("73696d706c792061206c6f6e6720737472696e67", "2cFupjhnEsSn59qHXstmK2ffpLv2"),
    ("00eb15231dfceb60925886b67d065299925915aeb172c06647", "1NS17iag9jJgTHD1VXjvLCEnZuQ3rJDE9L"),
    ("516b6fcd0f", "ABnLTmg"),
    ("bf4f89001e670274dd", "3SEo3LWLoPntC"),
    ("572e4794", "3EFU7m"),
    ("10c8511e", "Rt5zm"),
    ("00000000000000000000", "1111111111"),
)


@pytest.mark.parametrize(("raw", "text"), PAIRS)
def test_known_pairs(raw: str, text: str) -> None:
    assert base58.encode(bytes.fromhex(raw)) == text
    assert base58.decode(text) == bytes.fromhex(raw)


@given(st.binary(max_size=120))
@example(bytes(range(256)))
@example(bytes(40) + bytes(range(256)))
def test_what_was_encoded_is_decoded(data: bytes) -> None:
    assert base58.decode(base58.encode(data)) == data


@pytest.mark.parametrize("text", ["0", "O", "I", "l", "a b", "a\n", "+", "é", "\ud800", "\uff11"])
def test_what_is_not_in_the_alphabet_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        base58.decode(text)

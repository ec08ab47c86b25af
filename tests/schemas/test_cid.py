"""CIDv0 and base58."""

from __future__ import annotations

from contextlib import suppress
from hashlib import sha256

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas import InvalidCid, cid, cid_of_digest, format_cid, parse_cid
from schemas.cid import encode_base58, parse_ahead

EMPTY_FILE = "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH"


@given(st.binary(min_size=32, max_size=32))
def test_every_digest_has_a_cid_of_46_characters(digest: bytes) -> None:
    text = cid_of_digest(digest)
    assert len(text) == 46
    assert text.startswith("Qm")
    assert parse_cid(text) == b"\x12\x20" + digest
    assert format_cid(parse_cid(text)) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        EMPTY_FILE[:-1],
        EMPTY_FILE + "1",
        "1" + EMPTY_FILE[1:],
        "1" * 46,
        "z" * 46,
        "Qz" + EMPTY_FILE[2:],
        EMPTY_FILE.replace("F", "0"),
        EMPTY_FILE[:-1] + "é",
        " " + EMPTY_FILE[1:],
        encode_base58(b"\x12\x20" + bytes(31)),
        encode_base58(b"\x11\x14" + bytes(20)),
        encode_base58(b"\x16\x20" + sha256().digest()),
        "bafkreihdwdcefgh4dqkjv67uzcmw7ojee6xedzdetojuzjevtenxquvyku",
    ],
)
def test_cids_of_other_hashes_are_refused(text: str) -> None:
    with pytest.raises(InvalidCid) as caught:
        parse_cid(text)
    assert caught.value.text == text


BASE58 = st.text("123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz", min_size=46, max_size=46)
CIDS = st.binary(min_size=32, max_size=32).map(cid_of_digest)


@given(st.lists(CIDS | BASE58 | st.text(max_size=60), max_size=300))
@example([])
@example([EMPTY_FILE, "é" * 46, "z" * 46])
def test_parsing_ahead_changes_nothing(texts: list[str]) -> None:
    parse_ahead([])
    expected = [_parsed(text) for text in texts]
    parse_ahead(texts)
    assert [_parsed(text) for text in texts] == expected


def _parsed(text: str) -> bytes | None:
    cid._parse.cache_clear()
    with suppress(InvalidCid):
        return parse_cid(text)
    return None


@given(st.text(max_size=60) | BASE58)
def test_any_text_is_a_cid_or_raises_invalid_cid(text: str) -> None:
    with suppress(InvalidCid):
        assert format_cid(parse_cid(text)) == text


@pytest.mark.parametrize(
    "multihash", [b"", bytes(34), b"\x12\x20" + bytes(31), b"\x12\x20" + bytes(33), b"\x12\x21" + bytes(32)]
)
def test_other_multihashes_have_no_cid(multihash: bytes) -> None:
    with pytest.raises(InvalidCid):
        format_cid(multihash)


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
    assert encode_base58(bytes.fromhex(raw)) == text


@pytest.mark.parametrize("wrong", ["0", "O", "I", "l", " ", "\n", "+", "é", "\ud800", "\uff11"])
def test_characters_outside_the_base58_alphabet_are_refused(wrong: str) -> None:
    with pytest.raises(InvalidCid, match="alphabet"):
        parse_cid(EMPTY_FILE[:-1] + wrong)

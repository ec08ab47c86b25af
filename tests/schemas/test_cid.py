"""CIDv0."""

from __future__ import annotations

from contextlib import suppress
from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import InvalidCid, base58, cid_of_digest, format_cid, parse_cid

EMPTY_FILE = "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH"


@given(st.binary(min_size=32, max_size=32))
def test_every_digest_has_a_name_of_46_characters(digest: bytes) -> None:
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
        base58.encode(b"\x12\x20" + bytes(31)),
        base58.encode(b"\x11\x14" + bytes(20)),
        base58.encode(b"\x16\x20" + sha256().digest()),
        "bafkreihdwdcefgh4dqkjv67uzcmw7ojee6xedzdetojuzjevtenxquvyku",
    ],
)
def test_what_is_no_sha256_name_is_refused(text: str) -> None:
    with pytest.raises(InvalidCid) as caught:
        parse_cid(text)
    assert caught.value.text == text


@given(
    st.text(max_size=60)
    | st.text("123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz", min_size=46, max_size=46)
)
def test_no_text_raises_anything_but_invalid_cid(text: str) -> None:
    with suppress(InvalidCid):
        assert format_cid(parse_cid(text)) == text


@pytest.mark.parametrize(
    "multihash", [b"", bytes(34), b"\x12\x20" + bytes(31), b"\x12\x20" + bytes(33), b"\x12\x21" + bytes(32)]
)
def test_other_multihashes_have_no_name(multihash: bytes) -> None:
    with pytest.raises(InvalidCid):
        format_cid(multihash)

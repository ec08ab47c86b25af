"""Decoding what anybody may send: its depth is bounded first; one class of errors; the marks that editors write."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import InvalidMessage, InvalidRecord
from schemas.decoding import (
    MAX_DEPTH,
    InvalidData,
    decode_json,
    decode_msgpack,
    decode_toml,
    first_line,
    text_of,
    without_mark,
)
from schemas.messages import decode
from schemas.rpc import Done
from schemas.status import Status

ANYWHERE = """
import sys, threading
from schemas import Demand, InvalidMessage, InvalidPayload, InvalidRecord
from schemas.decoding import InvalidData, decode_json, decode_msgpack, decode_toml
from schemas.model import InvalidDescription, parse_description
from schemas.payloads import JSON, decode_value
from schemas.rpc import Done
from schemas.messages import decode

sys.setrecursionlimit(100_000)
threading.stack_size(512 << 10)
REFUSALS = InvalidData, InvalidDescription, InvalidMessage, InvalidPayload, InvalidRecord
deep = b"[" * 60_000
tries = [
    lambda: decode_json(deep), lambda: decode_json(deep.decode()), lambda: decode_json(b'{"a":' + deep),
    lambda: decode_json(b'{"a":' * 20_000), lambda: decode_msgpack(b"\\x91" * 60_000),
    lambda: decode_toml("a=" + deep.decode()), lambda: decode_toml("a." * 5_000 + "b=1"),
    lambda: decode(b'{"model":' + deep[:16_000]), lambda: decode(deep[:16_000], Demand),
    lambda: decode_value(deep, JSON), lambda: Done.decode(b'{"success":' + deep), lambda: parse_description(deep),
]
refused = []
def attempt():
    for one in tries:
        try:
            one()
        except REFUSALS as error:
            refused.append(error)
thread = threading.Thread(target=attempt)
thread.start()
thread.join()
print(len(refused) == len(tries))
"""


def nested(depth: int) -> bytes:
    return b"[" * depth + b"]" * depth


def test_deep_data_is_refused_on_a_small_stack_whatever_the_recursion_limit() -> None:
    done = subprocess.run([sys.executable, "-c", ANYWHERE], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


def test_the_limit_is_exact_and_what_stands_in_strings_does_not_count() -> None:
    assert decode_json(nested(MAX_DEPTH))
    many = [["[[{{", 'a"]]"', "\\", "\\["]] * 200
    assert decode_json(json.dumps(many)) == many
    for deeper in (nested(MAX_DEPTH + 1), b'{"a":' * (MAX_DEPTH + 1), b'["]","\\"]",' * 200 + nested(MAX_DEPTH)):
        with pytest.raises(InvalidData, match="nested") as refused:
            decode_json(deeper)
        assert refused.value.reason == "too-deep"


@given(st.recursive(st.text() | st.integers(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_shallow_data_is_decoded_as_it_was_written(value: Any) -> None:
    wide = [value] * 150
    assert decode_json(json.dumps(wide)) == wide
    assert decode_json(json.dumps(wide, ensure_ascii=False)) == wide


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_refused(data: bytes) -> None:
    for decoding in (
        lambda: decode_json(data),
        lambda: decode_msgpack(data),
        lambda: decode_toml(data.decode("latin-1")),
    ):
        with suppress(InvalidData):
            decoding()


def test_msgpack_and_toml_within_the_limit_are_decoded() -> None:
    value: Any = 1
    for _ in range(MAX_DEPTH):
        value = [value]
    assert decode_msgpack(msgspec.msgpack.encode(value)) == value
    assert decode_toml('a.b = [["["]]')["a"] == {"b": [["["]]}


def test_a_type_refuses_in_its_own_words() -> None:
    with pytest.raises(InvalidData, match=r"Expected `int`, got `str` - at `\$\[0\]`") as refused:
        decode_json(b'["1"]', list[int])
    assert refused.value.reason == "type"
    with pytest.raises(InvalidMessage, match="unknown-kind"):
        decode(b"[" * 16_000)


@pytest.mark.parametrize("uptime", ["1e308", "-1e308", "1e20", "1" + "0" * 300, "1e400", "NaN", "Infinity"])
def test_a_record_with_a_number_that_nothing_has_is_refused(uptime: str) -> None:
    status = Status(
        role="agent", address="", lighthouse="", parts={}, head=1, chain_id=1, version="", zenoh_id="", uptime=5.0
    )
    assert Status.decode(status.encode()) == status
    with pytest.raises(InvalidRecord):
        Status.decode(status.encode().replace(b'"uptime":5.0', b'"uptime":' + uptime.encode()))
    with pytest.raises(InvalidRecord):
        Status.decode(status.encode().replace(b'"head":1', b'"head":' + uptime.encode()))


def test_a_record_with_a_deep_member_is_refused() -> None:
    with pytest.raises(InvalidRecord, match="nested"):
        Done.decode(b'{"success":true,"msg":' + nested(MAX_DEPTH) + b"}")


def test_the_mark_of_utf_8_is_no_part_of_a_text() -> None:
    assert text_of("ключ = 1\r\n".encode("utf-8-sig")) == "ключ = 1\r\n"
    assert without_mark("\ufeff".encode()) == b""
    assert first_line(b"\xef\xbb\xbfhello world\r\n\r\n") == b"hello world"


def test_a_text_without_a_mark_is_as_it_is() -> None:
    assert text_of("a \ufeff b".encode()) == "a \ufeff b"
    assert first_line(b"") == b""
    assert first_line(b" two words \nmore") == b" two words "
    assert first_line("caf\xe9\n".encode("latin-1")) == b"caf\xe9"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-32", "utf-32-be"])
def test_another_encoding_with_a_mark_is_named(encoding: str) -> None:
    data = "\ufeffsecret".encode(encoding) if encoding.endswith("-be") else "secret".encode(encoding)
    for read in (without_mark, text_of, first_line):
        with pytest.raises(InvalidData) as caught:
            read(data)
        assert str(caught.value) == f"it is {encoding[:6].upper()} text, not UTF-8"


def test_bytes_that_are_no_text_are_not_shown() -> None:
    with pytest.raises(InvalidData) as caught:
        text_of("sésame".encode("latin-1"))
    assert "same" not in str(caught.value)

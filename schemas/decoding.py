"""Decoding JSON, msgpack and TOML that may come from anybody, and text that people have written: the only place for it.

Decoders in C recurse. How deep they may go is bounded by the interpreter's recursion limit, which libraries raise to
more than the stack of a thread holds; so what is nested too deep is refused before it is decoded, whatever that limit.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE, BOM_UTF32_BE, BOM_UTF32_LE
from functools import lru_cache
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final, TypeVar, overload

import msgspec

from schemas.errors import AiraError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable


T = TypeVar("T")

MAX_DEPTH: Final = 100
"""How deep lists and objects may be nested."""

_ESCAPE: Final = re.compile(rb"\\.", re.DOTALL)
_NO_BRACKETS: Final = bytes(set(range(256)) - set(b'[]{}"'))
_STEPS: Final = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")
"""What a bracket adds to the depth, as a signed byte."""
_NO_CONTAINERS: Final = bytes(set(range(256)) - set(range(0x80, 0xA0)) - set(range(0xDC, 0xE0)))
"""The bytes that open no list or map of msgpack."""


class InvalidData(InputError, code="invalid-data"):
    """Bytes are not JSON, msgpack or TOML, or not of the type that belongs here; or (`not-text`) not UTF-8.

    `reason` is `malformed`, `too-deep`, `type` or `not-text`. The text, in one line, may quote the bytes, but not those
    of what is no text: they may be a secret.
    """

    def __init__(self, reason: str, why: object, *, hint: str = "", code: str = "") -> None:
        super().__init__(str(why)[:200].encode("unicode_escape").decode(), hint=hint, code=code)
        self.reason = reason


@overload
def decode_json(data: bytes | str) -> Any: ...
@overload
def decode_json(data: bytes | str, kind: type[T], hook: Callable[[type[Any], Any], Any] | None = None) -> T: ...


def decode_json(data: bytes | str, kind: Any = None, hook: Callable[[type[Any], Any], Any] | None = None) -> Any:
    """The value in a JSON text, of that type; `hook` makes the types that msgspec does not know.

    Raises `InvalidData`, and the errors (`AiraError`) of checks of the type itself.
    """
    check_json_depth(data)
    try:
        return _json_decoder(kind, hook).decode(data)
    except (ValueError, RecursionError, OverflowError) as error:
        raise _refusal(error) from None


def decode_json_once(data: bytes | str) -> Any:
    """The value in a JSON text in which no object names a field twice: readers differ in which of the two counts.

    Slower than `decode_json`. Raises `InvalidData`; its reason is `repeated` for such a text.
    """
    import json

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) != len(pairs):
            raise InvalidData("repeated", "an object names a field twice")
        return found

    def no_number(name: str) -> Any:
        raise InvalidData("malformed", f"{name} is not a number of JSON")

    check_json_depth(data)
    try:
        return json.loads(data, object_pairs_hook=once, parse_constant=no_number)
    except InvalidData:
        raise
    except (ValueError, RecursionError) as error:
        raise _refusal(error) from None


@overload
def decode_msgpack(data: bytes) -> Any: ...
@overload
def decode_msgpack(data: bytes, kind: type[T]) -> T: ...


def decode_msgpack(data: bytes, kind: type[Any] | None = None) -> Any:
    """The value in bytes of msgpack, of that type. Raises as `decode_json` does.

    For short messages, such as those of boards: `too-deep` are all that have more than `MAX_DEPTH` bytes that could
    open a list or map.
    """
    if len(data.translate(None, _NO_CONTAINERS)) > MAX_DEPTH:
        raise _too_deep()
    try:
        return msgspec.msgpack.decode(data) if kind is None else msgspec.msgpack.decode(data, type=kind)
    except (ValueError, RecursionError, OverflowError) as error:
        raise _refusal(error) from None


def decode_toml(text: str) -> dict[str, Any]:
    """The table in a TOML text. Raises `InvalidData`."""
    import tomllib

    try:
        found = tomllib.loads(text)
    except RecursionError:
        raise _too_deep() from None
    except ValueError as error:
        raise InvalidData("malformed", error) from None
    level: list[Any] = [found]
    for _ in range(MAX_DEPTH):
        level = [
            member
            for value in level
            for member in (value.values() if isinstance(value, dict) else value)
            if isinstance(member, dict | list)
        ]
        if not level:
            return found
    raise _too_deep()


def check_json_depth(data: bytes | str) -> None:
    """Raise `InvalidData` (`too-deep`) for a JSON text that is nested too deep.

    Almost every text has fewer brackets than it may have levels; only of others the depth is measured.
    """
    brackets = ("[", "{") if isinstance(data, str) else (b"[", b"{")
    if data.count(brackets[0]) + data.count(brackets[1]) <= MAX_DEPTH:  # type: ignore[arg-type]
        return
    encoded = _ESCAPE.sub(b"", data.encode(errors="replace") if isinstance(data, str) else data)
    outside_strings = b"".join(encoded.translate(None, _NO_BRACKETS).split(b'"')[::2])
    steps = memoryview(outside_strings.translate(_STEPS)).cast("b")
    if max(accumulate(steps), default=0) > MAX_DEPTH:
        raise _too_deep()


def json_check(kind: Any) -> Callable[[bytes], bool]:
    """A function that says whether a text is JSON of a type, for types that are made at run time."""
    decode = msgspec.json.Decoder(kind).decode

    def is_of_kind(data: bytes) -> bool:
        try:
            check_json_depth(data)
            decode(data)
        except (ValueError, RecursionError, OverflowError):
            return False
        return True

    return is_of_kind


@lru_cache(maxsize=256)
def _json_decoder(kind: Any, hook: Callable[[type[Any], Any], Any] | None) -> msgspec.json.Decoder[Any]:
    return msgspec.json.Decoder() if kind is None else msgspec.json.Decoder(kind, dec_hook=hook)


def _refusal(error: Exception) -> AiraError:
    """What a decoder's error is to our callers."""
    if isinstance(error.__cause__, AiraError):
        return error.__cause__
    if isinstance(error, RecursionError):
        return _too_deep()
    return InvalidData("type" if isinstance(error, msgspec.ValidationError) else "malformed", error)


def _too_deep() -> InvalidData:
    return InvalidData("too-deep", f"lists and objects are nested more than {MAX_DEPTH} deep")


OTHER_MARKS: Final = {
    BOM_UTF32_LE: "UTF-32",  # first, because it begins with the mark of UTF-16
    BOM_UTF32_BE: "UTF-32",
    BOM_UTF16_LE: "UTF-16",
    BOM_UTF16_BE: "UTF-16",
}


def _not_text(why: str) -> InvalidData:
    return InvalidData("not-text", f"it is {why}", hint="save the file as UTF-8", code="not-text")


def without_mark(data: bytes) -> bytes:
    """The bytes of a UTF-8 text without a byte order mark. Raises `InvalidData` for UTF-16 or UTF-32."""
    for mark, name in OTHER_MARKS.items():
        if data.startswith(mark):
            raise _not_text(f"{name} text, not UTF-8")
    return data.removeprefix(BOM_UTF8)


def text_of(data: bytes) -> str:
    """A UTF-8 text without a byte order mark. Raises `InvalidData`."""
    try:
        return without_mark(data).decode()
    except UnicodeDecodeError:
        raise _not_text("not UTF-8 text") from None


def first_line(data: bytes) -> bytes:
    """The first line, such as a password, without a byte order mark and its line break. Raises `InvalidData`."""
    return next(iter(without_mark(data).splitlines()), b"")

"""Arguments of services as they are typed: `name=value`, or one JSON object."""

from __future__ import annotations

import difflib
import json
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.errors import InputError
from schemas import InvalidRecord
from schemas.records import UInt256
from schemas.rpc import SERVICES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from schemas import Record

TRUTHS: Final = {"true": True, "yes": True, "false": False, "no": False}
KINDS: Final[Mapping[Any, str]] = {
    UInt256: "a whole number, in the smallest unit",
    bool: "true or false",
    int: "a whole number",
    str: "text",
}
"""What is to be written for a value that is not any text."""


def wanted(kind: type[Record]) -> list[str]:
    """The names of a record's fields as they travel; those that may be left out are in brackets."""
    return [field.encode_name if field.required else f"[{field.encode_name}]" for field in _fields(kind)]


def request_of(service: str, arguments: Sequence[str]) -> Record:
    """The request to a service with these arguments.

    Raises `InputError`, which says what is missing, unknown or of another kind.
    """
    if service not in SERVICES:
        near = difflib.get_close_matches(service, SERVICES, n=1, cutoff=0)[0]
        raise InputError(f"there is no service {service[:60]!r}", hint=f"did you mean {near}? --list shows all")
    kind = SERVICES[service].request
    given = _given(arguments)
    _check_names(service, kind, given)
    values = {field.encode_name: _value(service, field, given[field.encode_name]) for field in _named(kind, given)}
    try:
        return kind.decode(msgspec.json.encode(values))
    except InvalidRecord as error:
        raise InputError(f"{service}: {error}") from None


def _given(arguments: Sequence[str]) -> dict[str, Any]:
    """What was typed, by name."""
    if len(arguments) == 1 and arguments[0].lstrip().startswith("{"):
        try:
            found = json.loads(arguments[0])
        except (ValueError, RecursionError) as error:
            raise InputError(f"the arguments are not JSON: {error}") from None
        assert isinstance(found, dict)
        return found
    given: dict[str, Any] = {}
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if not equals or not name:
            raise InputError(f"{argument[:60]!r} is no argument", hint="write name=value, or one JSON object")
        if name in given:
            raise InputError(f"{name[:60]} is given twice")
        given[name] = value
    return given


def _check_names(service: str, kind: type[Record], given: Mapping[str, Any]) -> None:
    known = [field.encode_name for field in _fields(kind)]
    takes = f"{service} takes {', '.join(wanted(kind)) or 'no arguments'}"
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            raise InputError(
                f"{service} has no argument {name[:60]!r}", hint=f"did you mean {near[0]}? {takes}" if near else takes
            )
    missing = [field.encode_name for field in _fields(kind) if field.required and field.encode_name not in given]
    if missing:
        raise InputError(f"{service} needs {', '.join(missing)}", hint=takes)


def _value(service: str, field: msgspec.structs.FieldInfo, given: Any) -> Any:
    """A value as it travels. In JSON an amount may be a number, though it travels as text."""
    kind: Any = field.type
    if kind is UInt256 and type(given) is int:
        given = str(given)
    if isinstance(given, str):
        if kind is bool and given.lower() in TRUTHS:
            return TRUTHS[given.lower()]
        if kind is int and given.isascii() and given.isdigit():
            return int(given)
        if kind is UInt256 and given.isascii() and given.isdigit():
            return given
    if kind not in KINDS or (type(given) is kind and kind is not UInt256):
        return given
    raise InputError(f"{service}: {field.encode_name} is {str(given)[:60]!r}, and has to be {KINDS[kind]}")


def _fields(kind: type[Record]) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(kind)


def _named(kind: type[Record], given: Mapping[str, Any]) -> list[msgspec.structs.FieldInfo]:
    return [field for field in _fields(kind) if field.encode_name in given]

"""What messages may say: topics, and the values of their fields, as people allow them in TOML.

    [topics."/drive"]
    radius = { min = 0.2, max = 2.0 }
    direction = { one_of = ["left", "right"] }
    pose.x = { min = -1, max = 1 }
    "points[].x" = { min = 0, max = 5, optional = true }
    label = { any = true }

    [topics."/speed"]               # a message that is a number, and has no fields
    max = 2

    [topics."/stop"]                # a message without a value

Nothing else is allowed: no other topic, no other field, no value of another type. A field must be there unless it is
`optional`. Names and texts are compared character by character. One check serves the policies of people, and what the
owner of a robot lets anybody order.
"""

from __future__ import annotations

import math
import unicodedata
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import msgspec

from schemas.errors import InputError, InvalidKey
from schemas.keys import topic_chunks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from schemas.model import Effort

Path: TypeAlias = tuple[str | int, ...]
"""Where something stands in a TOML file: keys, and numbers in lists."""

ANY_TOPIC: Final = "*"
MOST_VALUES: Final = 1_000_000
"""Values of an order's messages that are checked."""
_RULE_KEYS: Final = frozenset({"min", "max", "one_of", "any", "optional"})
_DEEPEST: Final = 16
"""Fields in fields."""


class TomlFault(NamedTuple):
    """A mistake in a file: where, and what."""

    path: Path
    why: str


class ValueFault(NamedTuple):
    """Why a message is not allowed: a word for programs, and a line for people."""

    code: str
    why: str


class ValueRule(msgspec.Struct, frozen=True, kw_only=True):
    """The values that a field may have: in a range, one of some, or any."""

    minimum: float | None = None
    maximum: float | None = None
    one_of: tuple[str | int | float | bool, ...] = ()
    is_optional: bool = False

    @property
    def is_any(self) -> bool:
        """Whether any value is allowed, also one with fields of its own."""
        return self.minimum is None and self.maximum is None and not self.one_of

    def __str__(self) -> str:
        """What is allowed, in words."""
        if self.one_of:
            shown = [_shown(one) for one in self.one_of]
            words = shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} or {shown[-1]}"
        elif self.is_any:
            words = "anything"
        elif self.minimum is None:
            words = f"at most {self.maximum:g}"
        elif self.maximum is None:
            words = f"at least {self.minimum:g}"
        else:
            words = f"{self.minimum:g} to {self.maximum:g}"
        return f"{words}, or nothing" if self.is_optional else words

    def fault(self, value: Any, name: str) -> str:
        """Why a value is not allowed; an empty text if it is."""
        if self.one_of:
            if not any(_is_same(value, one) for one in self.one_of):
                return f"{name} must be {self._required}, not {_shown(value)}"
            return ""
        if self.is_any:
            return ""
        if type(value) not in (int, float) or not math.isfinite(value):
            return f"{name} must be a number, {self._required}, not {_shown(value)}"
        is_low = self.minimum is not None and value < self.minimum
        if is_low or (self.maximum is not None and value > self.maximum):
            return f"{name} must be {self._required}, not {_shown(value)}"
        return ""

    @property
    def _required(self) -> str:
        return str(msgspec.structs.replace(self, is_optional=False))


class AllowedValue(msgspec.Struct, frozen=True, kw_only=True):
    """What a value may be: one of a `rule`, an array of `items`, an object of `fields`, or, without these, none."""

    rule: ValueRule | None = None
    items: AllowedValue | None = None
    fields: dict[str, AllowedValue] = {}

    @property
    def is_optional(self) -> bool:
        """Whether it may be missing: if all that it is made of may be."""
        if self.rule is not None:
            return self.rule.is_optional
        parts = [*self.fields.values(), *([] if self.items is None else [self.items])]
        return bool(parts) and all(part.is_optional for part in parts)

    def rules(self, path: str = "") -> Iterator[tuple[str, ValueRule]]:
        """The rules of all fields in it, with their paths: `pose.x`, `points[].x`."""
        if self.rule is not None:
            yield path, self.rule
        if self.items is not None:
            yield from self.items.rules(f"{path}[]")
        for name, inner in self.fields.items():
            yield from inner.rules(f"{path}.{name}" if path else name)

    def fault(self, value: Any, name: str, effort: Effort | None = None) -> ValueFault | None:
        """Why a value is not allowed, which is called `name`; None if it is. Raises `InputError` without effort left.

        `value` is JSON's: numbers, texts, truth values, None, lists, objects.
        """
        if self.rule is not None:
            why = self.rule.fault(value, name or "the value")
            return ValueFault("value-not-allowed", why) if why else None
        if self.items is not None:
            return self._items_fault(self.items, value, name, effort)
        if not self.fields:
            if value is None or value == {}:
                return None
            if isinstance(value, dict):
                return ValueFault("field-not-allowed", f"{_within(name, next(iter(value)))} is not allowed")
            return ValueFault("value-not-allowed", f"{name or 'the message'} must have no value, not {_shown(value)}")
        if type(value) is not dict:
            return ValueFault("value-not-allowed", f"{name or 'the message'} must have fields, not {_shown(value)}")
        if effort is not None:
            effort.spend(len(value) + len(self.fields))
        for key in value:
            if key not in self.fields:
                return ValueFault("field-not-allowed", f"the field {_within(name, key)} is not allowed")
        for key, allowed in self.fields.items():
            if key not in value:
                if not allowed.is_optional:
                    return ValueFault("value-not-allowed", f"the field {_within(name, key)} is missing")
            elif (fault := allowed.fault(value[key], _within(name, key), effort)) is not None:
                return fault
        return None

    def _items_fault(self, items: AllowedValue, value: Any, name: str, effort: Effort | None) -> ValueFault | None:
        if type(value) not in (list, tuple):
            return ValueFault("value-not-allowed", f"{name or 'the message'} must be an array, not {_shown(value)}")
        if effort is not None:
            effort.spend(len(value))
        faults = (items.fault(one, f"{name}[{number}]", effort) for number, one in enumerate(value))
        return next((fault for fault in faults if fault is not None), None)


class AllowedTopics(msgspec.Struct, frozen=True):
    """The topics on which messages are allowed, and what they may say. `*` stands for all others."""

    topics: dict[str, AllowedValue]

    @classmethod
    def read(cls, table: object, at: Path, faults: list[TomlFault]) -> AllowedTopics:
        """What a table of TOML at a path allows; mistakes are added to `faults`."""
        found: dict[str, AllowedValue] = {}
        if not isinstance(table, dict):
            faults.append(TomlFault(at, 'this is a table of topics, [….topics."/drive"]'))
            return cls({})
        for topic, allowed in table.items():
            place = (*at, topic)
            if topic != ANY_TOPIC:
                try:
                    topic_chunks(topic)
                except InvalidKey as error:
                    faults.append(TomlFault(place, f"{_shown(topic)} is not a topic: {error.why}"))
                    continue
                _check_name(topic, place, faults)
            found[topic] = _allowed_value(allowed, place, faults)
        return cls(found)

    def value(self, topic: str) -> AllowedValue | None:
        """What messages on a topic may say; None if it is not allowed."""
        return self.topics.get(topic) or self.topics.get(ANY_TOPIC)

    def fault(self, topic: str, value: Any, effort: Effort | None = None) -> ValueFault | None:
        """Why a message is not allowed; None if it is. Raises `InputError` if the `effort` is used up."""
        allowed = self.value(topic)
        if allowed is None:
            return ValueFault("topic-not-allowed", f"the topic {_shown(topic)} is not allowed")
        fault = allowed.fault(value, "", effort)
        return None if fault is None else ValueFault(fault.code, f"on {_shown(topic)} {fault.why}")

    def words(self) -> Iterator[str]:
        """What is allowed, a line for each topic."""
        for topic, allowed in self.topics.items():
            name = "any other topic" if topic == ANY_TOPIC else topic
            rules = [f"{path or 'the value'}: {rule}" for path, rule in allowed.rules()]
            yield f"{name} ({'; '.join(rules)})" if rules else f"{name} (no value)"


def read_topics(table: Mapping[str, Any], *, line: Callable[[Path], str] = lambda path: "") -> AllowedTopics:
    """What a file with `[topics."/…"]` allows, and nothing else. Raises `InputError` with its mistakes."""
    faults = [TomlFault((key,), f"unknown: {_shown(key)}") for key in table if key != "topics"]
    allowed = AllowedTopics.read(table.get("topics", {}), ("topics",), faults)
    if not faults and not allowed.topics:
        faults.append(TomlFault(("topics",), "no topic is allowed"))
    if faults:
        said = "; ".join(f"{line(fault.path)}{fault.why}" for fault in faults[:5])
        raise InputError(said, hint='write [topics."/drive"] and what its fields may be', code="invalid-option")
    return allowed


def _allowed_value(table: object, at: Path, faults: list[TomlFault], depth: int = 0) -> AllowedValue:
    """What a table of a topic or a field allows: a rule if it has anything but tables, else fields."""
    if not isinstance(table, dict):
        faults.append(TomlFault(at, 'write { min = 0, max = 1 }, { one_of = ["left"] } or { any = true }'))
        return AllowedValue()
    if depth > _DEEPEST:
        faults.append(TomlFault(at, f"fields are nested more than {_DEEPEST} deep"))
        return AllowedValue()
    if table and any(not isinstance(value, dict) for value in table.values()):
        return AllowedValue(rule=_rule(table, at, faults))
    root = _Branch()
    for name, inner in table.items():
        place = (*at, name)
        if (branch := root.at(name, place, faults)) is None:
            continue
        if branch.is_taken:
            faults.append(TomlFault(place, f"{_shown(name)} is named twice, or both with and without its parts"))
            continue
        branch.take(_allowed_value(inner, place, faults, depth + 1))
    return root.built(at, faults)


class _Branch:
    """A value of which the parts are read one after the other."""

    def __init__(self) -> None:
        self.given: AllowedValue | None = None
        self.items: _Branch | None = None
        self.fields: dict[str, _Branch] = {}

    @property
    def is_taken(self) -> bool:
        return self.given is not None or self.items is not None or bool(self.fields)

    def take(self, given: AllowedValue) -> None:
        self.given = given

    def at(self, path: str, place: Path, faults: list[TomlFault]) -> _Branch | None:
        """The part at a path such as `pose.x` or `points[].x`; None if it is no path."""
        branch = self
        for chunk in path.split("."):
            name = chunk.rstrip("[]")
            brackets = chunk[len(name) :]
            if brackets.replace("[]", "") or (not name and not brackets) or len(chunk) > 200:
                faults.append(TomlFault(place, f"{_shown(path)} is not the path of a field, as pose.x or points[].x"))
                return None
            if name:
                _check_name(name, place, faults)
                branch = branch.fields.setdefault(name, _Branch())
            for _ in range(len(brackets) // 2):
                branch.items = branch.items or _Branch()
                branch = branch.items
        return branch

    def built(self, at: Path, faults: list[TomlFault]) -> AllowedValue:
        if (self.given is not None) + (self.items is not None) + bool(self.fields) > 1:
            faults.append(TomlFault(at, "a field is described both as a whole and by its parts"))
        if self.given is not None:
            return self.given
        if self.items is not None:
            return AllowedValue(items=self.items.built(at, faults))
        return AllowedValue(fields={name: branch.built(at, faults) for name, branch in self.fields.items()})


def _rule(table: dict[str, Any], at: Path, faults: list[TomlFault]) -> ValueRule:
    before = len(faults)
    faults += [
        TomlFault((*at, key), f"unknown: {_shown(key)}; a field has min, max, one_of, any and optional")
        for key in table.keys() - _RULE_KEYS
    ]
    limits: dict[str, float | None] = {}
    for key in ("min", "max"):
        value = table.get(key)
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
            faults.append(TomlFault((*at, key), f"{key} is a number"))
            value = None
        limits[key] = value
    for key in ("any", "optional"):
        if key in table and type(table[key]) is not bool:
            faults.append(TomlFault((*at, key), f"{key} is true or false"))
    one_of = table.get("one_of", ())
    if "one_of" in table and (
        not isinstance(one_of, list) or not one_of or not all(type(one) in (str, int, float, bool) for one in one_of)
    ):
        faults.append(TomlFault((*at, "one_of"), "one_of is a list of texts, numbers, true or false, and not empty"))
        one_of = ()
    ranged = limits["min"] is not None or limits["max"] is not None
    if limits["min"] is not None and limits["max"] is not None and limits["min"] > limits["max"]:
        faults.append(TomlFault((*at, "min"), "min is above max"))
    if len(faults) == before and ranged + bool(one_of) + (table.get("any") is True) != 1:
        faults.append(TomlFault(at, "say one of: min and max; one_of; any = true"))
    return ValueRule(
        minimum=limits["min"], maximum=limits["max"], one_of=tuple(one_of), is_optional=table.get("optional") is True
    )


def _check_name(name: str, at: Path, faults: list[TomlFault]) -> None:
    if not name.isprintable() or unicodedata.normalize("NFKC", name) != name:
        faults.append(TomlFault(at, f"{name!a} has characters that look like others; write it plainly"))


def _is_same(value: Any, one: Any) -> bool:
    if isinstance(value, bool) or isinstance(one, bool):
        return value is one
    if isinstance(value, int | float) and isinstance(one, int | float):
        return value == one
    return type(value) is type(one) and bool(value == one)


def _within(name: str, key: object) -> str:
    text = _plain(str(key))
    return f"{name}.{text}" if name else text


def _plain(text: str) -> str:
    """A name for people: what is not ASCII is shown as its code, so that nothing looks like something else."""
    shown = text[:64].encode("ascii", "backslashreplace").decode()
    return "".join(one if one.isprintable() else "?" for one in shown)[:80] + ("…" if len(text) > 64 else "")


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f'"{_plain(value)}"'
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "nothing"}[value]
    if isinstance(value, int | float):
        return f"{value!r}"[:40] if not isinstance(value, int) or abs(value) < 10**30 else "a very large number"
    return "an object" if isinstance(value, dict) else "an array" if isinstance(value, list | tuple) else "bytes"

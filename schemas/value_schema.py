"""The values of a topic: their type, range, unit and meaning, in a strict subset of JSON Schema.

A schema has no references, no patterns and no alternatives, so that checking a value takes time in proportion to the
value, and a form can be built from it.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from schemas.errors import InputError

MAX_DEPTH: Final = 8
"""How deep schemas may be nested."""
SAFE_INTEGER: Final = 2**53 - 1
"""The largest integer that every JSON reader keeps exactly."""

Number: TypeAlias = int | float
Scalar: TypeAlias = str | int | float | bool
Title: TypeAlias = Annotated[str, Meta(max_length=80)]
Prose: TypeAlias = Annotated[str, Meta(max_length=4000)]
Length: TypeAlias = Annotated[int, Meta(ge=0, le=SAFE_INTEGER)]
FieldName: TypeAlias = Annotated[str, Meta(min_length=1, max_length=64)]
Choice: TypeAlias = Annotated[str, Meta(max_length=200)] | int

_JSON_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "null": (type(None),),
    "boolean": (bool,),
    "integer": (int, float),  # without a fraction
    "number": (int, float),
    "string": (str,),
    "array": (list, tuple),
    "object": (dict,),
}
_NUMBERS: Final = ("minimum", "maximum", "exclusive_minimum", "exclusive_maximum", "unit")
_KEYWORDS: Final = {
    **dict.fromkeys(_NUMBERS, ("integer", "number")),
    "enum": ("integer", "string"),
    "min_length": ("string",),
    "max_length": ("string",),
    "content_encoding": ("string",),
    "items": ("array",),
    "min_items": ("array",),
    "max_items": ("array",),
    "properties": ("object",),
    "required": ("object",),
}
"""Which types have which keywords; those not named here are for all."""


class TooManyValues(InputError, code="too-many-values"):
    """A stranger's values are too many to be checked one by one."""


class Effort:
    """How many values of arrays and objects may be checked: a stranger's compressed file may have millions."""

    def __init__(self, values: int) -> None:
        self._left = values

    def spend(self, values: int) -> None:
        """Count values. Raises `TooManyValues`."""
        self._left -= values
        if self._left < 0:
            raise TooManyValues("there are more values than are checked")


class ValueSchema(
    msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, rename="camel", forbid_unknown_fields=True
):
    """What values are allowed, with the keywords of JSON Schema and their meaning there, and a `unit`.

    Without a `type` any value is. `content_encoding` is `base64` for bytes in JSON. Properties that are not listed may
    have any value. `default` is what a form begins with. Constructing one raises `ValueError` if a keyword does not
    belong to the type, or if keywords contradict each other.
    """

    type: Literal["", "null", "boolean", "integer", "number", "string", "array", "object"] = ""
    title: Title = ""
    description: Prose = ""
    unit: Annotated[str, Meta(max_length=20)] = ""
    default: Scalar | None = None
    enum: Annotated[tuple[Choice, ...], Meta(max_length=256)] = ()
    minimum: Number | None = None
    maximum: Number | None = None
    exclusive_minimum: Number | None = None
    exclusive_maximum: Number | None = None
    min_length: Length | None = None
    max_length: Length | None = None
    content_encoding: Literal["base64"] | None = None
    items: ValueSchema | None = None
    min_items: Length | None = None
    max_items: Length | None = None
    properties: Annotated[dict[FieldName, ValueSchema], Meta(max_length=256)] = {}
    required: Annotated[tuple[FieldName, ...], Meta(max_length=256)] = ()

    def __post_init__(self) -> None:
        for field in ("default", *_NUMBERS[:4]):
            force_setattr(self, field, normal_number(field, getattr(self, field)))
        for text in (self.title, self.unit, *(name for name in self.properties)):
            require_plain_text(text)
        require_plain_text(self.description, lines=True)
        for field, types in _KEYWORDS.items():
            if getattr(self, field) not in (None, "", (), {}) and self.type not in types:
                raise ValueError(f"{field} belongs to {' and '.join(types)}, not to {self.type or 'any value'}")
        self._check_agreement()
        if self.depth > MAX_DEPTH:
            raise ValueError(f"schemas are nested more than {MAX_DEPTH} deep")

    def _check_agreement(self) -> None:
        for low, high in (("minimum", "maximum"), ("min_length", "max_length"), ("min_items", "max_items")):
            least, most = getattr(self, low), getattr(self, high)
            if least is not None and most is not None and least > most:
                raise ValueError(f"{low} is above {high}")
        if len(set(self.enum)) != len(self.enum) or len(set(self.required)) != len(self.required):
            raise ValueError("a name or a choice is listed twice")
        if missing := [name for name in self.required if name not in self.properties]:
            raise ValueError(f"required {missing[0]!r} is not a property")
        for choice in self.enum:
            if isinstance(choice, str):
                require_plain_text(choice)
            if why := self.fault(choice, "a choice"):
                raise ValueError(why)
        if self.default is not None and (why := self.fault(self.default, "the default")):
            raise ValueError(why)

    @property
    def depth(self) -> int:
        """How deep schemas are nested in it; 1 if there are none."""
        inner = [*self.properties.values(), *([self.items] if self.items is not None else [])]
        return 1 + max((schema.depth for schema in inner), default=0)

    def fault(self, value: Any, name: str = "value", effort: Effort | None = None) -> str:
        """Why a value of JSON does not fit, in one line that calls it `name`; an empty text if it fits.

        With an `effort`, raises `TooManyValues` when that is used up.
        """
        if not self.type:
            return ""
        if type(value) not in _JSON_TYPES[self.type]:
            return f"{name} must be {_article(self.type)}, not {_shown(value)}"
        why = self._own_fault(value)
        if why:
            return f"{name} {why}"
        if self.type == "array":
            return self._items_fault(value, name, effort)
        return self._properties_fault(value, name, effort) if self.type == "object" else ""

    def _own_fault(self, value: Any) -> str:
        """The same for a value of the right type, without what is in it."""
        match self.type:
            case "integer" | "number":
                why = self._number_fault(value)
            case "string":
                why = _outside(len(value), self.min_length, self.max_length, "characters")
            case "array":
                why = _outside(len(value), self.min_items, self.max_items, "items")
            case _:
                why = ""
        if not why and self.enum and value not in self.enum:
            return f"must be one of {_shown_list(self.enum)}, not {_shown(value)}"
        return why

    def _number_fault(self, value: Number) -> str:
        if not _is_finite(value):
            return f"must be a finite number, not {value}"
        if self.type == "integer" and isinstance(value, float) and not value.is_integer():
            return f"must be an integer, not {value}"
        unit = f" {self.unit}" if self.unit else ""
        for allowed, limit, words in (
            (self.minimum is None or value >= self.minimum, self.minimum, "at least"),
            (self.maximum is None or value <= self.maximum, self.maximum, "at most"),
            (self.exclusive_minimum is None or value > self.exclusive_minimum, self.exclusive_minimum, "more than"),
            (self.exclusive_maximum is None or value < self.exclusive_maximum, self.exclusive_maximum, "less than"),
        ):
            if not allowed:
                return f"must be {words} {limit}{unit}, not {value}{unit}"
        return ""

    def _items_fault(self, values: list[Any] | tuple[Any, ...], name: str, effort: Effort | None) -> str:
        items = self.items
        if items is None or not items.type or items._holds(values):
            return ""
        if effort is not None:
            effort.spend(len(values))
        for number, value in enumerate(values):
            if why := items.fault(value, f"{name}[{number}]", effort):
                return why
        return ""

    def _holds(self, values: list[Any] | tuple[Any, ...]) -> bool:
        """Whether all values are numbers that fit; False also if that takes a look at each. For long arrays."""
        if self.type not in ("integer", "number") or self.enum or not values:
            return False
        if not set(map(type, values)) <= ({int} if self.type == "integer" else {int, float}):
            return False
        if not _is_finite(sum(values)):  # one of them is not, or the sum is too large
            return False
        return not self._number_fault(min(values)) and not self._number_fault(max(values))

    def _properties_fault(self, values: dict[str, Any], name: str, effort: Effort | None) -> str:
        if effort is not None:
            effort.spend(len(self.properties) + len(self.required))
        for required in self.required:
            if required not in values:
                return f"{name} lacks {required}"
        for key, schema in self.properties.items():
            if key in values and (why := schema.fault(values[key], f"{name}.{key}", effort)):
                return why
        return ""


def require_plain_text(text: str, *, lines: bool = False) -> None:
    """Raise `ValueError` for text that a page or a terminal would not show as it is; `lines` may end lines."""
    shown = text.replace("\n", "") if lines else text
    if not shown.isprintable() or text != text.strip():
        raise ValueError("a text has control characters, or blanks around it")


def normal_number(field: str, value: Any) -> Any:
    """A number in canonical form: a float without a fraction is an integer."""
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{field} is not a finite number")
        value = int(value) if value.is_integer() and abs(value) <= SAFE_INTEGER else value
    if isinstance(value, int) and abs(value) > SAFE_INTEGER:
        raise ValueError(f"{field} is beyond {SAFE_INTEGER}, which some readers of JSON can't keep")
    return value


def _is_finite(value: Number) -> bool:
    return isinstance(value, int) or math.isfinite(value)


def _outside(size: int, least: int | None, most: int | None, what: str) -> str:
    if least is not None and size < least:
        return f"must have at least {least} {what}, not {size}"
    if most is not None and size > most:
        return f"must have at most {most} {what}, not {size}"
    return ""


def _article(kind: str) -> str:
    return "null" if kind == "null" else f"{'an' if kind[0] in 'aio' else 'a'} {kind}"


def _shown(value: Any) -> str:
    names = {type(None): "null", bytes: "bytes", dict: "an object", list: "an array", tuple: "an array"}
    text = names.get(type(value)) or "".join(one if one.isprintable() else "\ufffd" for one in str(value)[:80])
    return text if len(text) <= 40 else text[:39] + "…"


def _shown_list(choices: tuple[Any, ...]) -> str:
    return ", ".join(_shown(choice) for choice in choices[:8]) + (", …" if len(choices) > 8 else "")

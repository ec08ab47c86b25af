"""A description of a model: what its objectives play, what its results hold, what a success is, price and duration.

A model is the CID of a file. If the file is a description, programs can check objectives against it and build order
forms from it; any other file, such as a text for people, is a model without a description.

The values of a topic are described in a strict subset of JSON Schema: their type, range, unit and meaning. A schema has
no references, no patterns and no alternatives, so that checking a value takes time in proportion to the value, and a
form can be built from it. `topic_of` describes a topic by the Python type of its messages.
"""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF8
from inspect import cleandoc
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from schemas.decoding import InvalidData, decode_json, without_mark
from schemas.errors import InputError, InvalidKey
from schemas.keys import topic_chunks
from schemas.payloads import EMPTY, RAW, STRING, Empty, String
from schemas.records import LONGEST_PRICE
from schemas.unixfs import cid_of_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from schemas.payloads import PayloadType


class DescriptionLimits(NamedTuple):
    """How large the description of a model is."""

    size: int = 65_536
    """Bytes."""
    topics: int = 64
    """Topics of the objective, and of the result."""
    depth: int = 8
    """How deep schemas may be nested."""


DESCRIPTION_LIMITS: Final = DescriptionLimits()
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


class Effort:
    """How many values of arrays and objects may be checked: a stranger's compressed file may have millions."""

    def __init__(self, values: int) -> None:
        self._left = values

    def spend(self, values: int) -> None:
        """Count values. Raises `InputError` (`too-many-values`)."""
        self._left -= values
        if self._left < 0:
            raise InputError("there are more values than are checked", code="too-many-values")


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
        if self.depth > DESCRIPTION_LIMITS.depth:
            raise ValueError(f"schemas are nested more than {DESCRIPTION_LIMITS.depth} deep")

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

        With an `effort`, raises `InputError` when that is used up.
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


FORMAT: Final = "aira-model/1"
"""The `format` of a description; its first field, so that the file says what it is."""
PRICE: Final = r"[0-9]{1,30}(\.[0-9]{1,18})? ([A-Za-z][A-Za-z0-9.]{0,15}|0x[0-9a-fA-F]{40})"
_YEAR: Final = 31_536_000

Seconds: TypeAlias = Annotated[int, Meta(gt=0, le=_YEAR)] | Annotated[float, Meta(gt=0, le=_YEAR)]


class InvalidDescription(InputError, code="invalid-description"):
    """A file is not a valid description of a model.

    `reason` is a word for programs: `too-large`, `not-json`, `not-a-description` (its `format` is another), `field`, or
    `not-canonical` (valid, but its bytes are not those of `ModelDescription.encode`). `detail` is for people.
    """

    def __init__(self, reason: str, detail: str) -> None:
        hint = "`aira model new` writes the canonical form" if reason == "not-canonical" else ""
        super().__init__(f"not a description of a model ({reason}): {detail}", hint=hint)
        self.reason = reason
        self.detail = detail


class ModelFault(NamedTuple):
    """What of an objective does not fit a description: a word for programs (see `Preflight`), and text for people."""

    reason: str
    detail: str


class _Described(
    msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, rename="camel", forbid_unknown_fields=True
):
    """The base of the parts of a description."""


class ModelTopic(_Described, frozen=True):
    """A topic of objectives, or of results.

    `value` describes the value of each message, as JSON has it: null for std_msgs/Empty, a text for std_msgs/String;
    without it, any payload is allowed. `encoding` is the payload's, as in Zenoh (`ros1;std_msgs/String`); without it,
    any encoding of the value is. If the topic is `required`, there is at least one message on it.
    """

    topic: Annotated[str, Meta(max_length=200)]
    title: Title = ""
    description: Prose = ""
    encoding: Annotated[str, Meta(max_length=200)] = ""
    value: ValueSchema | None = None
    required: bool = False
    max_messages: Length | None = None

    def __post_init__(self) -> None:
        for text in (self.title, self.encoding):
            require_plain_text(text)
        require_plain_text(self.description, lines=True)
        try:
            topic_chunks(self.topic)
        except InvalidKey as error:
            raise ValueError(str(error)) from None

    def fault(self, kind: PayloadType, value: Any, effort: Effort | None = None) -> str:
        """Why a message does not fit: one line, empty if it fits. `value` is its decoded payload.

        Raises `InputError` if the `effort` is used up.
        """
        actual = kind.zenoh_encoding
        if self.encoding and actual != self.encoding and not actual.startswith(f"{self.encoding};"):
            return f"its encoding must be {self.encoding}, not {actual}"
        if self.value is None or (self.encoding and isinstance(value, bytes)):  # a type that nobody here decodes
            return ""
        return self.value.fault(json_value(value), effort=effort)


class ModelLimits(_Described, frozen=True):
    """The largest objective: messages in all, seconds from the first to the last, bytes of the file."""

    messages: Length | None = None
    seconds: Seconds | None = None
    size: Length | None = None

    def __post_init__(self) -> None:
        force_setattr(self, "seconds", normal_number("seconds", self.seconds))


class ModelDescription(_Described, frozen=True, tag_field="format", tag=FORMAT):
    """What a robot of a model does. All texts are plain text, for people.

    `objective` are the topics that an objective plays, and no others, unless `other_topics`. `result` are those of the
    recording that comes back; a success has at least one message on each required one, and is what `success` says.
    `price` is typical, as are the `seconds` that a job takes. It names its token by a symbol that is known on the chain
    (`5 XRT`, `3.50 USDC`), or by the address (`3.50 0x…`); `units` is the smallest unit of the token that pays there.
    `on_stop` says what becomes of the cost when the customer stops a job that has begun: it comes back (`refund`), or
    the robot keeps it (`paid`).
    """

    title: Annotated[str, Meta(min_length=1, max_length=80)]
    description: Prose = ""
    objective: Annotated[tuple[ModelTopic, ...], Meta(max_length=DESCRIPTION_LIMITS.topics)] = ()
    other_topics: bool = False
    result: Annotated[tuple[ModelTopic, ...], Meta(max_length=DESCRIPTION_LIMITS.topics)] = ()
    success: Prose = ""
    price: Annotated[str, Meta(max_length=LONGEST_PRICE, extra_json_schema={"pattern": f"^{PRICE}$"})] = ""
    seconds: Seconds | None = None
    on_stop: Literal["refund", "paid"] = "refund"
    limits: ModelLimits | None = None

    def __post_init__(self) -> None:
        force_setattr(self, "seconds", normal_number("seconds", self.seconds))
        require_plain_text(self.title)
        for text in (self.description, self.success):
            require_plain_text(text, lines=True)
        if self.price and not re.fullmatch(PRICE, self.price):
            raise ValueError("a price is like `5 XRT`, `3.50 USDC` or `3 units`")
        for topics in (self.objective, self.result):
            if len({topic.topic for topic in topics}) != len(topics):
                raise ValueError("a topic is described twice")

    @property
    def cid(self) -> str:
        """The CID of its canonical bytes: the model."""
        return cid_of_bytes(self.encode())

    def encode(self) -> bytes:
        """The canonical bytes: JSON, two blanks per level, fields in this order and without those that have defaults.

        Raises `InvalidDescription` if a field is out of its range.
        """
        data = msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"
        read_description(data)  # a constructor does not check lengths and ranges
        return data

    def topic(self, name: str) -> ModelTopic | None:
        """The description of a topic of objectives."""
        return next((topic for topic in self.objective if topic.topic == name), None)

    def message_fault(
        self, topic: str, kind: PayloadType, value: Any, effort: Effort | None = None
    ) -> ModelFault | None:
        """Why an objective must not play a message; None if it may. `value` is its decoded payload.

        `effort` is for all messages of the objective.
        """
        described = self.topic(topic)
        if described is None:
            return None if self.other_topics else ModelFault("unknown-topic", f"the model has no topic {topic}")
        try:
            why = described.fault(kind, value, effort)
        except InputError as error:
            return ModelFault("expands-too-much", str(error))
        return ModelFault("unfit-message", why) if why else None

    def objective_fault(self, counts: Mapping[str, int], *, duration_ns: int, size: int) -> ModelFault | None:
        """What is wrong with an objective as a whole: `counts` are its messages by topic, `size` is in bytes."""
        for topic in self.objective:
            count = counts.get(topic.topic, 0)
            if topic.required and not count:
                return ModelFault("missing-topic", f"the model needs a message on {topic.topic}")
            if topic.max_messages is not None and count > topic.max_messages:
                detail = f"it has {count} messages on {topic.topic}, the model allows {topic.max_messages}"
                return ModelFault("too-many-messages", detail)
        limits = self.limits or ModelLimits()
        for actual, most, unit, reason in (
            (sum(counts.values()), limits.messages, "messages", "too-many-messages"),
            (duration_ns / 1e9, limits.seconds, "seconds", "too-long"),
            (size, limits.size, "bytes", "too-large"),
        ):
            if most is not None and actual > most:
                return ModelFault(reason, f"it has {actual:,} {unit}, the model allows {most:,}")
        return None


def is_description(data: bytes) -> bool:
    """Whether a model's file says that it is a description; any other file is a model without one."""
    return data.removeprefix(BOM_UTF8).lstrip()[:1] == b"{" and FORMAT.encode() in data[:200]


def read_description(data: bytes) -> ModelDescription:
    """The description in a model's file. Raises `InvalidDescription`."""
    description = parse_description(data)
    if data != msgspec.json.format(msgspec.json.encode(description), indent=2) + b"\n":
        detail = "the file has another layout, order of fields or form of numbers, or a byte order mark"
        raise InvalidDescription("not-canonical", detail)
    return description


def parse_description(data: bytes) -> ModelDescription:
    """The description in JSON that need not be canonical, as people write it. Raises `InvalidDescription`."""
    if len(data) > DESCRIPTION_LIMITS.size:
        raise InvalidDescription("too-large", f"it has {len(data)} bytes; the limit is {DESCRIPTION_LIMITS.size}")
    try:
        return decode_json(without_mark(data), ModelDescription)
    except InvalidData as error:
        reason = "field" if error.reason == "type" else "not-json"
        raise InvalidDescription("not-a-description" if "$.format" in str(error) else reason, str(error)) from None


def description_schema() -> bytes:
    """The JSON Schema of descriptions, for editors and other programs. Some rules of the reader are not in it."""
    (root,), definitions = msgspec.json.schema_components((ModelDescription,), ref_template="#/$defs/{name}")
    for definition in definitions.values():
        definition["description"] = cleandoc(definition["description"])
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root, "$defs": definitions}
    return msgspec.json.format(msgspec.json.encode(schema), indent=2) + b"\n"


def json_value(value: Any) -> Any:
    """A decoded payload as JSON has it: the fields of a message, or the value itself if its only field is `data`."""
    if not isinstance(value, msgspec.Struct):
        return value
    fields = {name: json_value(getattr(value, name)) for name in value.__struct_fields__}
    if not fields:
        return None
    return fields["data"] if list(fields) == ["data"] else fields


_KEPT: Final = (
    *("type", "title", "unit", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength", "maxLength"),
    *("contentEncoding", "minItems", "maxItems"),
)
"""The keywords that msgspec and a schema of values share; others only describe, or go beyond what is checked."""


def topic_of(topic: str, kind: Any, **fields: Any) -> ModelTopic:
    """The description of a topic whose messages have a Python type: a Struct, `float`, `String`, …

    `fields` are the others of `ModelTopic`. Limits, title and unit of a value are those of `msgspec.Meta` (the unit in
    `extra_json_schema={"unit": "m/s"}`). A type that no schema can describe is described as any value. Raises
    `InvalidDescription` if a name or a limit is out of range.
    """
    if kind is bytes:
        return ModelTopic(topic=topic, encoding=RAW.zenoh_encoding, **fields)
    if kind is Empty:
        return ModelTopic(topic=topic, encoding=EMPTY.zenoh_encoding, value=ValueSchema(type="null"), **fields)
    if kind is String:
        return ModelTopic(topic=topic, encoding=STRING.zenoh_encoding, value=ValueSchema(type="string"), **fields)
    value = schema_of(kind)
    return ModelTopic(topic=topic, value=value if value != ValueSchema() else None, **fields)


def schema_of(kind: Any) -> ValueSchema:
    """The schema of the values of a Python type in JSON; see `topic_of`."""
    try:
        (root,), definitions = msgspec.json.schema_components((kind,), ref_template="{name}")
    except (TypeError, RecursionError):
        return ValueSchema()
    try:
        return msgspec.convert(_narrowed(root, definitions), ValueSchema)
    except msgspec.ValidationError as error:
        raise InvalidDescription("field", f"{getattr(kind, '__name__', kind)}: {error}") from None


def topic_gap(described: ModelTopic, taken: ModelTopic) -> str:
    """Why a message that fits a described topic may not fit what a handler takes, in one line; empty if each does."""
    name, raw = described.topic, RAW.zenoh_encoding
    if taken.encoding == raw and (described.value is not None or not described.encoding):
        return f"{name} must have an encoding and no value: the handler takes bytes"
    if taken.encoding not in ("", raw, described.encoding):
        return f"{name} must have the encoding {taken.encoding}, which is what the handler takes"
    return _gap(described.value or ValueSchema(), taken.value or ValueSchema(), name)


def _gap(described: ValueSchema, taken: ValueSchema, name: str) -> str:
    if not taken.type:
        return ""
    if described.type != taken.type and (described.type, taken.type) != ("integer", "number"):
        return f"{name} is {described.type or 'any value'} for the model, and {taken.type} for the handler"
    if described.enum:
        return next(filter(None, (taken.fault(choice, name) for choice in described.enum)), "")
    (low, high), (least, most) = _bounds(described), _bounds(taken)
    if taken.enum or low < least or high > most:
        return f"{name} may have values for the model that the handler does not take"
    if missing := [field for field in taken.required if field not in described.required]:
        return f"{name} may lack {missing[0]}, which the handler needs"
    if taken.items is not None and (why := _gap(described.items or ValueSchema(), taken.items, f"{name}[]")):
        return why
    shared = [field for field in taken.properties if field in described.properties]
    inner = (_gap(described.properties[field], taken.properties[field], f"{name}.{field}") for field in shared)
    return next(filter(None, inner), "")


def _bounds(schema: ValueSchema) -> tuple[tuple[float, int], tuple[float, int]]:
    """The least and the greatest number, length or count, each with a number that orders exclusive bounds."""
    lows = ((schema.minimum, 0), (schema.exclusive_minimum, 1), (schema.min_length, 0), (schema.min_items, 0))
    highs = ((schema.maximum, 1), (schema.exclusive_maximum, 0), (schema.max_length, 1), (schema.max_items, 1))
    low = max(((limit, order) for limit, order in lows if limit is not None), default=(-inf, 0))
    high = min(((limit, order) for limit, order in highs if limit is not None), default=(inf, 1))
    return low, high


def _narrowed(schema: Any, definitions: dict[str, Any], above: tuple[str, ...] = ()) -> dict[str, Any]:
    """What a schema of msgspec says, in the keywords of `ValueSchema`; a type within itself is any value."""
    if not isinstance(schema, dict):
        return {}
    if reference := schema.get("$ref"):
        if reference in above:
            return {}
        own = {key: value for key, value in schema.items() if key != "$ref"}
        definition = {key: value for key, value in definitions[reference].items() if key != "title"}  # a class's name
        return _narrowed({**definition, **own}, definitions, (*above, reference))
    if alternatives := schema.get("anyOf"):
        others = [one for one in alternatives if one != {"type": "null"}]
        rest = {key: value for key, value in schema.items() if key != "anyOf"}
        return _narrowed({**others[0], **rest}, definitions, above) if len(others) == 1 else {}
    narrowed = {key: schema[key] for key in _KEPT if key in schema}
    if text := " ".join(cleandoc(schema.get("description", "")).split()):
        narrowed["description"] = text
    if isinstance(schema.get("default"), str | int | float) and "enum" not in schema:
        narrowed["default"] = schema["default"]
    if choices := schema.get("enum"):
        kind = {str: "string", int: "integer"}.get(type(choices[0]) if len(set(map(type, choices))) == 1 else object)
        narrowed |= {"type": kind, "enum": choices} if kind else {}
        if kind and schema.get("default") in choices:
            narrowed["default"] = schema["default"]
    if schema.get("type") == "array":
        narrowed |= {"items": items} if (items := _narrowed(schema.get("items"), definitions, above)) else {}
    if schema.get("type") == "object":
        inner = {key: _narrowed(one, definitions, above) for key, one in schema.get("properties", {}).items()}
        narrowed |= {"properties": inner} if inner else {}
        narrowed |= {"required": required} if (required := schema.get("required")) else {}
    return narrowed

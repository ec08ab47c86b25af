"""A description of a model: what its objectives play, what its results hold, what a success is, price and duration.

A model is the CID of a file. If the file is a description, programs can check objectives against it and build order
forms from it; any other file, such as a text for people, is a model without a description.
"""

from __future__ import annotations

import re
from inspect import cleandoc
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from schemas.agent_keys import topic_chunks
from schemas.errors import InputError, InvalidKey
from schemas.unixfs import cid_of_bytes
from schemas.value_schema import (
    Effort,
    Length,
    Prose,
    Title,
    TooManyValues,
    ValueSchema,
    normal_number,
    require_plain_text,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from schemas.payloads import PayloadType

FORMAT: Final = "aira-model/1"
"""The `format` of a description; its first field, so that the file says what it is."""
MAX_MODEL_SIZE: Final = 65_536
"""Bytes of the longest description."""
MAX_TOPICS: Final = 64
_PRICE: Final = r"[0-9]{1,30}(\.[0-9]{1,18})? (XRT|wn|units)"
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

        Raises `TooManyValues` if the `effort` is used up.
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
    `price` is typical (`5 XRT`; `units` is the smallest unit of another token), as are the `seconds` that a job takes.
    """

    title: Annotated[str, Meta(min_length=1, max_length=80)]
    description: Prose = ""
    objective: Annotated[tuple[ModelTopic, ...], Meta(max_length=MAX_TOPICS)] = ()
    other_topics: bool = False
    result: Annotated[tuple[ModelTopic, ...], Meta(max_length=MAX_TOPICS)] = ()
    success: Prose = ""
    price: Annotated[str, Meta(max_length=60, extra_json_schema={"pattern": f"^{_PRICE}$"})] = ""
    seconds: Seconds | None = None
    limits: ModelLimits | None = None

    def __post_init__(self) -> None:
        force_setattr(self, "seconds", normal_number("seconds", self.seconds))
        require_plain_text(self.title)
        for text in (self.description, self.success):
            require_plain_text(text, lines=True)
        if self.price and not re.fullmatch(_PRICE, self.price):
            raise ValueError("a price is like `5 XRT`, `100 wn` or `3 units`")
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
        except TooManyValues as error:
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
    return data.lstrip()[:1] == b"{" and FORMAT.encode() in data[:200]


def read_description(data: bytes) -> ModelDescription:
    """The description in a model's file. Raises `InvalidDescription`."""
    description = parse_description(data)
    if data != msgspec.json.format(msgspec.json.encode(description), indent=2) + b"\n":
        raise InvalidDescription("not-canonical", "the file has another layout, order of fields, or form of numbers")
    return description


def parse_description(data: bytes) -> ModelDescription:
    """The description in JSON that need not be canonical, as people write it. Raises `InvalidDescription`."""
    if len(data) > MAX_MODEL_SIZE:
        raise InvalidDescription("too-large", f"it has {len(data)} bytes; the limit is {MAX_MODEL_SIZE}")
    try:
        return _DECODER.decode(data)
    except msgspec.ValidationError as error:
        reason = "not-a-description" if "$.format" in str(error) else "field"
        raise InvalidDescription(reason, _one_line(error)) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidDescription("not-json", _one_line(error)) from None


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


def _one_line(error: Exception) -> str:
    """The text of an error, which may quote its input, in one line."""
    return str(error)[:200].encode("unicode_escape").decode()


_DECODER: Final = msgspec.json.Decoder(ModelDescription)

"""Descriptions of models: their canonical form, what is refused, which objectives fit; and those of Python types."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import EMPTY, JSON, RAW, STRING, Empty, PayloadType, String, cid_of_bytes
from schemas.model import (
    DESCRIPTION_LIMITS,
    SAFE_INTEGER,
    Effort,
    InvalidDescription,
    ModelDescription,
    ModelLimits,
    ModelTopic,
    ValueSchema,
    is_description,
    parse_description,
    read_description,
    schema_of,
    topic_gap,
    topic_of,
)

SPEED = ValueSchema(type="number", title="Speed", unit="m/s", minimum=0, maximum=2, default=0.5)
DRIVE = ModelDescription(
    title="Drive",
    description="Drives.\nStops at the end.",
    objective=(
        ModelTopic(
            topic="/drive",
            title="Drive",
            value=ValueSchema(type="object", properties={"speed": SPEED}, required=("speed",)),
            required=True,
            max_messages=3,
        ),
        ModelTopic(
            topic="/lamp", encoding="ros1;std_msgs/String", value=ValueSchema(type="string", enum=("on", "off"))
        ),
        ModelTopic(topic="/stop", encoding=EMPTY.zenoh_encoding, value=ValueSchema(type="null")),
        ModelTopic(topic="/map", encoding="application/octet-stream"),
    ),
    result=(ModelTopic(topic="/position", value=ValueSchema(type="array", items=SPEED, max_items=3), required=True),),
    success="It has stopped where it should.",
    price="5 XRT",
    seconds=2.5,
    limits=ModelLimits(messages=5, seconds=60, size=10_000),
)
SMALL = b'{\n  "format": "aira-model/1",\n  "title": "Small"\n}\n'


def refused(data: bytes) -> str:
    with pytest.raises(InvalidDescription) as caught:
        read_description(data)
    assert "\n" not in str(caught.value)
    return caught.value.reason


def test_a_description_is_read_as_it_was_written_and_its_bytes_are_the_model() -> None:
    data = DRIVE.encode()
    assert read_description(data) == DRIVE
    assert DRIVE.cid == cid_of_bytes(data)
    assert ModelDescription(title="Small").encode() == SMALL


numbers = st.none() | st.integers(-SAFE_INTEGER, SAFE_INTEGER) | st.floats(-1e15, 1e15)
schemas = st.recursive(
    st.builds(ValueSchema, type=st.sampled_from(("", "boolean", "null", "string")), title=st.sampled_from(("", "Räum")))
    | st.builds(
        ValueSchema, type=st.just("number"), minimum=numbers.filter(lambda one: one is None or abs(one) < 1e15)
    ),
    lambda inner: (
        st.builds(ValueSchema, type=st.just("array"), items=inner)
        | st.builds(
            ValueSchema, type=st.just("object"), properties=st.dictionaries(st.sampled_from("abc"), inner, max_size=3)
        )
    ),
    max_leaves=5,
)


@given(schemas, st.booleans())
def test_every_description_has_one_form(value: ValueSchema, required: bool) -> None:
    description = ModelDescription(title="x", objective=(ModelTopic(topic="/a", value=value, required=required),))
    assert read_description(description.encode()) == description
    assert parse_description(msgspec.json.encode(description)).encode() == description.encode()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"# Blink\n", "not-json"),
        (b"\xff", "not-json"),
        (b'{"title":"x","objective":[{"topic":"/a","value":' + b'{"items":' * 5000, "not-json"),
        (b'{"format":"aira-model/2","title":"x"}', "not-a-description"),
        (b"{}", "field"),
        (b'{"title":"x","titel":"y"}', "field"),
        (SMALL.rstrip(), "not-canonical"),
        (SMALL.replace(b'"Small"', b'"Other",\n  "title": "Small"'), "not-canonical"),
        (SMALL.replace(b'"Small"', b'"Small",\n  "seconds": 1.0'), "not-canonical"),
        (SMALL.replace(b'"Small"', b'"Small",\n  "seconds": 0'), "field"),
        (SMALL.replace(b'"Small"', b'"Small",\n  "price": "five"'), "field"),
        (SMALL.replace(b"Small", b"S" * 81), "field"),
        (SMALL.replace(b"Small", b"\\u202eSmall"), "field"),
        (SMALL.replace(b"Small", b"Small\\n"), "field"),
        (SMALL.replace(b"Small", b"S" * DESCRIPTION_LIMITS.size), "too-large"),
        (SMALL.replace(b'"Small"', b'"Small","objective":[{"topic":"go"}]'), "field"),
        (SMALL.replace(b'"Small"', b'"Small","objective":[{"topic":"/a"},{"topic":"/a"}]'), "field"),
    ],
)
def test_what_is_no_description_is_refused_with_a_reason(data: bytes, reason: str) -> None:
    assert refused(data) == reason


@pytest.mark.parametrize(
    "fields",
    [
        {"type": "text"},
        {"type": "string", "minimum": 1},
        {"minimum": 1},
        {"type": "number", "enum": (1,)},
        {"type": "number", "minimum": 2, "maximum": 1},
        {"type": "number", "minimum": 2**53},
        {"type": "number", "minimum": 1, "default": 0},
        {"type": "integer", "default": True},
        {"type": "string", "enum": ("a", "a")},
        {"type": "string", "enum": ("a", 1)},
        {"type": "string", "max_length": 1, "enum": ("ab",)},
        {"type": "object", "required": ("a",)},
        {"type": "object", "properties": {"": {}}},
        {"type": "object", "properties": {"a\n": {}}},
        {"type": "string", "pattern": "(a+)+$"},
        {"$ref": "#"},
    ],
)
def test_a_schema_that_contradicts_itself_or_says_more_than_we_check_is_refused(fields: dict[str, Any]) -> None:
    camel = {"min_length": "minLength", "max_length": "maxLength"}
    value = {camel.get(name, name): field for name, field in fields.items()}
    with pytest.raises(InvalidDescription) as caught:
        parse_description(msgspec.json.encode({"title": "x", "objective": [{"topic": "/a", "value": value}]}))
    assert caught.value.reason == "field"


def test_schemas_are_nested_only_so_deep() -> None:
    schema = ValueSchema()
    for _ in range(DESCRIPTION_LIMITS.depth - 1):
        schema = ValueSchema(type="array", items=schema)
    assert schema.depth == DESCRIPTION_LIMITS.depth
    with pytest.raises(ValueError, match="deep"):
        ValueSchema(type="array", items=schema)


@pytest.mark.parametrize(
    ("topic", "kind", "value", "reason"),
    [
        ("/drive", JSON, {"speed": 2}, None),
        ("/drive", PayloadType("json", "Move", "jsonschema"), {"speed": 0.0, "other": []}, None),
        ("/drive", JSON, {"speed": 2.001}, "unfit-message"),
        ("/drive", JSON, {"speed": True}, "unfit-message"),
        ("/drive", JSON, {"speed": float("nan")}, "unfit-message"),
        ("/drive", JSON, {}, "unfit-message"),
        ("/drive", JSON, [], "unfit-message"),
        ("/drive", RAW, b"{}", "unfit-message"),
        ("/lamp", STRING, String("on"), None),
        ("/lamp", STRING, String("red"), "unfit-message"),
        ("/lamp", JSON, "on", "unfit-message"),
        ("/stop", EMPTY, Empty(), None),
        ("/stop", JSON, None, "unfit-message"),
        ("/map", RAW, b"anything", None),
        ("/map", JSON, {}, "unfit-message"),
        ("/fly", EMPTY, Empty(), "unknown-topic"),
    ],
)
def test_a_message_fits_or_not(topic: str, kind: PayloadType, value: object, reason: str | None) -> None:
    fault = DRIVE.message_fault(topic, kind, value)
    assert (fault and fault.reason) == reason


def test_other_topics_are_played_where_the_model_says_so() -> None:
    open_one = msgspec.structs.replace(DRIVE, other_topics=True)
    assert open_one.message_fault("/fly", EMPTY, Empty()) is None
    assert open_one.message_fault("/stop", JSON, None) is not None


@pytest.mark.parametrize(
    ("counts", "seconds", "size", "reason"),
    [
        ({"/drive": 1}, 60, 10_000, None),
        ({"/stop": 1}, 1, 1, "missing-topic"),
        ({"/drive": 4}, 1, 1, "too-many-messages"),
        ({"/drive": 3, "/stop": 3}, 1, 1, "too-many-messages"),
        ({"/drive": 1}, 61, 1, "too-long"),
        ({"/drive": 1}, 1, 10_001, "too-large"),
    ],
)
def test_an_objective_fits_as_a_whole_or_not(
    counts: dict[str, int], seconds: int, size: int, reason: str | None
) -> None:
    fault = DRIVE.objective_fault(counts, duration_ns=seconds * 10**9, size=size)
    assert (fault and fault.reason) == reason


@pytest.mark.parametrize(
    ("values", "fits"),
    [
        ([0, 1.5, 2], True),
        ([], True),
        ([1] * 4, False),
        ([1, -1], False),
        ([1, 3], False),
        ([1, "a"], False),
        ([1, float("nan")], False),
        ([1, float("inf")], False),
        ([1, True], False),
    ],
)
def test_every_number_of_an_array_is_checked(values: list[Any], fits: bool) -> None:
    schema = ValueSchema(type="array", items=SPEED, max_items=3)
    assert (schema.fault(values) == "") is fits


def test_a_file_that_says_it_is_a_description_is_one_or_is_refused() -> None:
    assert is_description(SMALL)
    assert is_description(b'{"format":"aira-model/1", "title": 5}')
    assert not is_description(b"# A model of a lamp")
    assert not is_description(b'{"title": "x"}')


@pytest.mark.parametrize(("value", "fits"), [(5, True), (5.0, True), (5.5, False), (True, False), ("5", False)])
def test_an_integer_may_be_written_as_a_float(value: Any, fits: bool) -> None:
    schema = ValueSchema(type="integer", minimum=1)
    assert (schema.fault(value) == "") is fits
    assert (ValueSchema(type="array", items=schema).fault([2, value]) == "") is fits


def test_what_is_said_about_a_strangers_value_is_one_printable_line() -> None:
    fault = DRIVE.message_fault("/lamp", STRING, String("on\n\x1b[2Jfake"))
    assert fault is not None
    assert fault.detail.isprintable()


@pytest.mark.parametrize(("value", "fits"), [(0, False), (0.01, True), (1.99, True), (2, False)])
def test_exclusive_bounds_are_exclusive(value: float, fits: bool) -> None:
    schema = ValueSchema(type="number", exclusive_minimum=0, exclusive_maximum=2)
    assert (schema.fault(value) == "") is fits


def test_an_encoding_without_a_name_fits_every_type_of_that_encoding() -> None:
    topic = ModelTopic(topic="/a", encoding="application/json")
    assert topic.fault(PayloadType("json", "Move", "jsonschema"), {}) == ""
    assert topic.fault(STRING, String("{}")) != ""


def test_only_so_many_values_are_checked() -> None:
    inner = ValueSchema(type="object", properties={"a": ValueSchema(type="number")})
    topic = ModelTopic(topic="/a", value=ValueSchema(type="array", items=inner))
    model, value = ModelDescription(title="x", objective=(topic,)), [{"a": 1}] * 100
    effort = Effort(250)
    assert model.message_fault("/a", JSON, value, effort) is None
    fault = model.message_fault("/a", JSON, value, effort)
    assert fault is not None
    assert fault.reason == "expands-too-much"
    numbers = ModelTopic(topic="/a", value=ValueSchema(type="array", items=ValueSchema(type="number")))
    assert numbers.fault(JSON, [1.5] * 1000, Effort(0)) == ""


Metres = Annotated[
    float, msgspec.Meta(ge=0, lt=2, title="Speed", description="How fast.", extra_json_schema={"unit": "m/s"})
]


class Colour(enum.Enum):
    RED = "red"
    BLUE = "blue"


class Move(msgspec.Struct):
    """Moves
    the robot."""

    speed: Metres = 0.5
    colour: Colour = Colour.RED
    mode: Literal["a", "b"] = "a"
    legs: list[int] | None = None
    picture: bytes = b""
    both: int | str = 0


@dataclass
class Turn:
    degrees: int


class Tree(msgspec.Struct):
    name: str
    children: list[Tree] = []


def test_a_struct_is_described_with_its_ranges_units_titles_and_defaults() -> None:
    assert schema_of(Move) == ValueSchema(
        type="object",
        description="Moves the robot.",
        properties={
            "speed": ValueSchema(
                type="number",
                title="Speed",
                description="How fast.",
                unit="m/s",
                default=0.5,
                minimum=0,
                exclusive_maximum=2,
            ),
            "colour": ValueSchema(type="string", default="red", enum=("blue", "red")),
            "mode": ValueSchema(type="string", default="a", enum=("a", "b")),
            "legs": ValueSchema(type="array", items=ValueSchema(type="integer")),
            "picture": ValueSchema(type="string", default="", content_encoding="base64"),
            "both": ValueSchema(),
        },
    )


@pytest.mark.parametrize(
    ("kind", "described"),
    [
        (Turn, {"type": "object", "properties": {"degrees": {"type": "integer"}}, "required": ["degrees"]}),
        (float, {"type": "number"}),
        (bool, {"type": "boolean"}),
        (str, {"type": "string"}),
        (list[float], {"type": "array", "items": {"type": "number"}}),
        (dict[str, int], {"type": "object"}),
        (Literal[1, 2], {"type": "integer", "enum": [1, 2]}),
        (Annotated[int, msgspec.Meta(ge=1)], {"type": "integer", "minimum": 1}),
        (Any, {}),
        (float | str, {}),
        (object, {}),
    ],
)
def test_every_type_of_a_handler_is_described(kind: Any, described: dict[str, Any]) -> None:
    assert msgspec.json.decode(msgspec.json.encode(schema_of(kind))) == described


def test_a_type_that_contains_itself_ends() -> None:
    children = schema_of(Tree).properties["children"]
    assert children == ValueSchema(type="array")


def test_the_types_of_ros_and_bytes_have_an_encoding() -> None:
    assert topic_of("/a", Empty, required=True) == ModelTopic(
        topic="/a", encoding=EMPTY.zenoh_encoding, value=ValueSchema(type="null"), required=True
    )
    assert topic_of("/a", String).encoding == STRING.zenoh_encoding
    assert topic_of("/a", bytes) == ModelTopic(topic="/a", encoding=RAW.zenoh_encoding)
    assert topic_of("/a", Any) == ModelTopic(topic="/a")


def test_a_type_with_limits_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidDescription) as caught:
        schema_of(Annotated[int, msgspec.Meta(le=2**60)])
    assert caught.value.reason == "field"


NUMBER = {"type": "number"}


@pytest.mark.parametrize(
    ("described", "kind", "fits"),
    [
        ({"value": NUMBER}, float, True),
        ({"value": {"type": "integer"}}, float, True),
        ({"value": NUMBER}, int, False),
        ({"value": NUMBER}, str, False),
        ({}, float, False),
        ({}, Any, True),
        ({"value": NUMBER}, Any, True),
        ({"value": NUMBER | {"minimum": 0, "exclusiveMaximum": 2}}, Metres, True),
        ({"value": NUMBER | {"exclusiveMinimum": 0, "maximum": 1}}, Metres, True),
        ({"value": NUMBER | {"minimum": 0, "maximum": 2}}, Metres, False),
        ({"value": NUMBER | {"minimum": -1, "maximum": 1}}, Metres, False),
        ({"value": NUMBER | {"minimum": 0}}, Metres, False),
        ({"value": {"type": "string", "enum": ["red"]}}, Colour, True),
        ({"value": {"type": "string", "enum": ["red", "green"]}}, Colour, False),
        ({"value": {"type": "string"}}, Colour, False),
        ({"value": {"type": "object", "properties": {"degrees": NUMBER}, "required": ["degrees"]}}, Turn, False),
        (
            {"value": {"type": "object", "properties": {"degrees": {"type": "integer"}}, "required": ["degrees"]}},
            Turn,
            True,
        ),
        ({"value": {"type": "object", "properties": {"degrees": {"type": "integer"}}}}, Turn, False),
        ({"value": {"type": "array", "items": NUMBER}}, list[float], True),
        ({"value": {"type": "array"}}, list[float], False),
        ({"value": {"type": "null"}, "encoding": "ros1;std_msgs/Empty"}, Empty, True),
        ({"value": {"type": "null"}}, Empty, False),
        ({"value": {"type": "string"}, "encoding": "ros1;std_msgs/String"}, String, True),
        ({"value": {"type": "string"}, "encoding": "ros1;std_msgs/String"}, str, True),
        ({"encoding": "ros1;sensor_msgs/Image"}, bytes, True),
        ({}, bytes, False),
    ],
)
def test_a_described_topic_fits_what_a_handler_takes_or_not(described: dict[str, Any], kind: Any, fits: bool) -> None:
    topic = msgspec.convert({"topic": "/a", **described}, ModelTopic)
    assert (topic_gap(topic, topic_of("/a", kind)) == "") is fits

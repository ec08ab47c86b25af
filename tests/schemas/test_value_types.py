"""From Python types to descriptions of topics, and whether a description fits what a handler takes."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import pytest

from schemas import EMPTY, RAW, STRING, Empty, String
from schemas.model import InvalidDescription, ModelTopic
from schemas.value_schema import ValueSchema
from schemas.value_types import schema_of, topic_gap, topic_of

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

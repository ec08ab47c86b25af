from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import msgspec

from mesh.recording import Recorder, RecordingAbout, json_type, open_objective
from schemas.payloads import JSON

if TYPE_CHECKING:
    from pathlib import Path


class Point(msgspec.Struct):
    x: Annotated[float, msgspec.Meta(ge=0, description="metres")]
    y: float = 0.0


class Way(msgspec.Struct):
    """Where to go."""

    points: list[Point]
    after: Way | None = None


class Pair(msgspec.Struct, array_like=True):
    left: int


class Waves(msgspec.Struct):
    sum: complex


def test_a_struct_is_described_as_an_object_with_its_fields_and_units() -> None:
    kind = json_type(Point)
    schema = json.loads(kind.schema_data)
    assert (kind.encoding, kind.schema_name, kind.schema_encoding) == ("json", "Point", "jsonschema")
    assert schema["type"] == "object"
    assert schema["properties"]["x"] == {"type": "number", "minimum": 0, "description": "metres"}
    assert schema["required"] == ["x"]


def test_what_a_struct_refers_to_is_in_its_schema_itself_too() -> None:
    schema = json.loads(json_type(Way).schema_data)
    assert schema["type"] == "object"
    assert set(schema["$defs"]) == {"Point", "Way"}
    assert schema["properties"]["points"]["items"] == {"$ref": "#/$defs/Point"}


def test_what_is_no_object_in_json_or_has_no_schema_is_plain_json() -> None:
    assert json_type(Pair) == JSON
    assert json_type(Waves) == JSON


def test_the_schema_is_in_the_recording(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", RecordingAbout()) as recorder:
        recorder.record("/point", msgspec.json.encode(Point(1.0)), json_type(Point))
    (topic,) = open_objective(tmp_path / "it.mcap").topics
    assert topic.type == json_type(Point)

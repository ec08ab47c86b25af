"""Message rates, and types with JSON schemas."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import msgspec

from mesh.recording import Played, Recorder, RecordingAbout, json_type, open_objective, pack, rates_of
from schemas.payloads import JSON, RAW, encode_value, payload_type

if TYPE_CHECKING:
    from pathlib import Path


def at(topic: str, *times: int) -> list[Played]:
    return [Played(topic, b"", time, time, 0, RAW) for time in times]


def test_messages_are_counted_in_equal_spans_from_the_first_to_the_last() -> None:
    messages = at("/a", 100, 101, 149, 150, 199, 200) + at("/b", 200)
    rates = rates_of(messages, start_ns=100, duration_ns=100, spans=2)
    assert rates.counts == {"/a": [4, 2], "/b": [0, 1]}
    assert rates.span_ns == 51


def test_messages_of_one_moment_fall_in_one_span() -> None:
    rates = rates_of(at("/a", 7, 7), start_ns=7, duration_ns=0, spans=4)
    assert rates.counts == {"/a": [2, 0, 0, 0]}


def test_counts_convert_to_messages_per_second() -> None:
    rates = rates_of(at("/a", 0, 1, 999_999_999), start_ns=0, duration_ns=999_999_999, spans=2)
    assert rates.per_second("/a") == [4.0, 2.0]


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


def test_a_struct_has_a_schema_with_its_fields_and_units() -> None:
    kind = json_type(Point)
    schema = json.loads(kind.schema_data)
    assert (kind.encoding, kind.schema_name, kind.schema_encoding) == ("json", "Point", "jsonschema")
    assert schema["type"] == "object"
    assert schema["properties"]["x"] == {"type": "number", "minimum": 0, "description": "metres"}
    assert schema["required"] == ["x"]


def test_a_schema_includes_the_structs_it_refers_to() -> None:
    schema = json.loads(json_type(Way).schema_data)
    assert schema["type"] == "object"
    assert schema["properties"]["points"]["items"] == json.loads(json_type(Point).schema_data)
    assert "after" not in schema["properties"]


def test_types_without_an_object_schema_are_plain_json() -> None:
    assert json_type(Pair) == JSON
    assert json_type(Waves) == JSON


def test_the_schema_is_in_the_recording(tmp_path: Path) -> None:
    with Recorder(tmp_path / "it.mcap", RecordingAbout()) as recorder:
        recorder.record("/point", msgspec.json.encode(Point(1.0)), json_type(Point))
    (topic,) = open_objective(tmp_path / "it.mcap").topics
    assert topic.type == json_type(Point)


def test_programs_name_files_by_text_and_read_values(tmp_path: Path) -> None:
    made, copied = f"{tmp_path}/made.mcap", f"{tmp_path}/copied.mcap"
    with Recorder(made, RecordingAbout()) as recorder:
        for value in (1.5, "text", None, {"x": [1]}, b"bytes"):
            recorder.record("/it", *encode_value(value))
        recorder.record("/it", b"no number", payload_type("ros1;std_msgs/Float64"))
    pack(open_objective(made).messages(), copied)
    found = [message.value for message in open_objective(copied).messages()]
    assert found == [1.5, "text", None, {"x": [1]}, b"bytes", b"no number"]

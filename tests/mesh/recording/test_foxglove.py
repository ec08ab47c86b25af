"""Foxglove's own message types: the fields that its viewer needs, in a recording of what an agent publishes."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import pytest

from mesh import Recorder, RecordingAbout, foxglove
from mesh.recording import JsonSchemas, encode_described, json_type
from schemas.payloads import JSON, payload_type
from tests.support.recordings import check_viewable, decoded

if TYPE_CHECKING:
    from pathlib import Path

PICTURE = foxglove.CompressedImage(data=b"\xff\xd8", format="jpeg")
REQUIRED = [
    (PICTURE, "CompressedImage", "timestamp frame_id data format"),
    (
        foxglove.LocationFix(latitude=52.5, longitude=13.4),
        "LocationFix",
        "timestamp frame_id latitude longitude altitude position_covariance position_covariance_type",
    ),
    (foxglove.Log(message="ready"), "Log", "timestamp level message name file line"),
    (foxglove.PoseInFrame(pose=foxglove.Pose()), "PoseInFrame", "timestamp frame_id pose"),
    (
        foxglove.FrameTransform(parent_frame_id="map", child_frame_id="base"),
        "FrameTransform",
        "timestamp parent_frame_id child_frame_id translation rotation",
    ),
    (
        foxglove.LaserScan(start_angle=0.0, end_angle=1.0, ranges=(1.0, 2.0)),
        "LaserScan",
        "timestamp frame_id pose start_angle end_angle ranges intensities",
    ),
]
"""Foxglove's required fields of each."""


@pytest.mark.parametrize(("message", "name", "fields"), REQUIRED, ids=lambda one: one if isinstance(one, str) else "")
def test_a_message_has_the_fields_that_the_viewer_needs(
    tmp_path: Path, message: object, name: str, fields: str
) -> None:
    payload, kind = encode_described(message)
    assert kind.schema_name == f"foxglove.{name}"
    with Recorder(tmp_path / "it.mcap", RecordingAbout()) as recorder:
        recorder.record("/it", payload, kind)
    ((_, read),) = decoded(tmp_path / "it.mcap")
    assert set(read) == set(fields.split())
    assert set(json.loads(kind.schema_data)["properties"]) == set(read)


def test_a_picture_is_bytes_also_where_only_the_name_of_its_type_travels() -> None:
    payload, kind = encode_described(PICTURE)
    heard = JsonSchemas().describe("/camera", payload, payload_type(kind.zenoh_encoding))
    assert heard == kind
    assert json.loads(heard.schema_data)["properties"]["data"] == {"type": "string", "contentEncoding": "base64"}
    assert base64.b64decode(json.loads(payload)["data"]) == PICTURE.data


class Wheel(msgspec.Struct):
    speed: float


@dataclass
class State:
    wheels: list[Wheel]
    position: tuple[float, float, float]
    mode: Literal["drive", "stop"]
    level: foxglove.LogLevel
    grid: list[list[int]]
    limits: dict[str, Wheel]
    goal: float | None = None


class Tree(msgspec.Struct):
    name: str
    children: list[Tree] = []


def test_viewers_read_the_schema_of_any_class() -> None:
    for kind in (State, Tree):
        check_viewable(json.loads(json_type(kind).schema_data))
    members: dict[str, Any] = json.loads(json_type(State).schema_data)["properties"]
    assert members["wheels"]["items"]["properties"]["speed"] == {"type": "number"}
    assert (members["position"]["type"], members["position"]["items"]) == ("array", {"type": "number"})
    assert (members["mode"]["type"], members["level"]["type"]) == ("string", "integer")
    assert "goal" not in members  # a schema with two types, and the topic is not shown at all


def test_viewers_read_the_schema_of_messages_without_a_class() -> None:
    schemas = JsonSchemas()
    values: list[Any] = [{"x": 1, "none": None, "empty": [], "grid": [[1]], "in": {}}, {"x": 1.5, "in": 5}, {"x": 2}]
    for value in values:
        found = json.loads(schemas.describe("/it", msgspec.json.encode(value), JSON).schema_data)
        check_viewable(found)
        assert found["properties"]["x"] == {"type": "number"}
    check_viewable(json.loads(JSON.schema_data))

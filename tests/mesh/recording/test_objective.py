"""Message rates, types with JSON schemas, and whether an objective can be played."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Annotated

import msgspec
import pytest

from mesh.recording import (
    Limits,
    Played,
    Recorder,
    RecordingAbout,
    json_type,
    open_objective,
    pack,
    preflight,
    rates_of,
)
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from schemas.payloads import JSON, RAW, encode_value, payload_type
from tests.support.bags import Bag, BagMessage, string
from tests.support.objectives import objective
from tests.support.recording.files import SECOND, T0, mcap_file, with_messages

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.writer import Writer


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


GOOD = with_messages([T0, T0 + 8 * 24 * 3600 * SECOND - 1])


def on_topic(topic: str, payload: bytes = b"{}") -> bytes:
    def write(writer: Writer) -> None:
        writer.add_message(writer.register_channel(topic, "json", 0), T0, payload, T0)

    return mcap_file(write)


@pytest.mark.parametrize("content", [with_messages([T0]), Bag([BagMessage("/a", string("x"), T0)]).encode()])
def test_a_good_objective_is_returned_open(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path)
    assert outcome.ok
    assert outcome.reason == ""
    assert outcome.objective is not None
    assert outcome.objective.count == 1


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not-a-recording"),
        (b"hello, I am a text", "not-a-recording"),
        (b"#ROSBAG V1.2\n", "not-a-recording"),
        (GOOD[:-9], "corrupt"),
        (mcap_file(lambda writer: None), "no-messages"),
        (GOOD, "too-long"),
        (on_topic("a b"), "unplayable-topic"),
        (on_topic("/a/**"), "unplayable-topic"),
        (on_topic("/c"), "unknown-topic"),
        (on_topic("/a", b"{"), "unreadable-message"),
        (with_messages([T0] * 3000), "too-large"),
        (with_messages([T0] * 300), "expands-too-much"),
    ],
)
def test_an_unplayable_objective_has_a_reason(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path, Limits(size=30_000, expanded=8000), topics={"/a", "/b", "a b", "/a/**"})
    assert not outcome.ok
    assert outcome.reason == reason
    assert outcome.detail
    assert (outcome.objective is None) == (reason in ("not-a-recording", "corrupt", "too-large", "expands-too-much"))


def test_without_a_device_any_topic_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(on_topic("/whatever"))
    assert preflight(path).ok


def test_a_path_that_is_not_a_regular_file_is_not_a_recording(tmp_path: Path) -> None:
    assert preflight(tmp_path / "missing").reason == "not-a-recording"
    assert preflight(tmp_path).reason == "not-a-recording"
    os.mkfifo(tmp_path / "pipe")
    assert preflight(tmp_path / "pipe").reason == "not-a-recording"


@pytest.mark.parametrize(("kind", "payload"), [("std_msgs/String", b"\x09\0\0\0x"), ("std_msgs/Empty", b"x")])
def test_a_message_that_contradicts_its_type_is_reported(tmp_path: Path, kind: str, payload: bytes) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([BagMessage("/b", payload, T0 + n, type=kind) for n in range(3)]).encode())
    outcome = preflight(path)
    assert outcome.reason == "unreadable-message"
    assert outcome.detail.startswith(f"message 0 on /b: not a {kind}: ")


def test_an_unknown_type_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(Bag([BagMessage("/b", b"\xff", T0, type="my/Type")]).encode())
    assert preflight(path).ok


def test_the_first_message_that_no_handler_accepts_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "objective"

    def write(writer: Writer) -> None:
        channel = writer.register_channel("/a", "json", 0)
        for payload in (b"1", b"2", b"30", b"40"):
            writer.add_message(channel, T0, payload, T0)

    path.write_bytes(mcap_file(write))
    asked: list[tuple[str, object]] = []

    def obstacle(topic: str, said: object) -> str:
        asked.append((topic, said))
        return "it is too much" if said == 30 else ""

    outcome = preflight(path, obstacle=obstacle)
    assert (outcome.reason, outcome.detail) == ("unfit-message", "message 2 on /a: it is too much")
    assert asked == [("/a", 1), ("/a", 2), ("/a", 30)]


def test_too_much_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "objective"
    path.write_bytes(on_topic("/a", b"[" + b" " * 1000 + b"]"))
    assert preflight(path, Limits(json=1002)).ok
    assert preflight(path, Limits(json=1001)).reason == "expands-too-much"


MODEL = ModelDescription(
    title="Says a number",
    objective=(
        ModelTopic(topic="/a", value=ValueSchema(type="integer", minimum=1), required=True, max_messages=2),
        ModelTopic(topic="/b"),
    ),
)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (objective(("/a", 1), ("/b", "any")), ""),
        (objective(("/a", 0)), "unfit-message"),
        (objective(("/a", 1), ("/c", 1)), "unknown-topic"),
        (objective(("/b", 1)), "missing-topic"),
        (objective(("/a", 1), ("/a", 1), ("/a", 1)), "too-many-messages"),
    ],
)
def test_an_objective_fits_the_description_of_the_model(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "objective"
    path.write_bytes(content)
    outcome = preflight(path, model=MODEL)
    assert (outcome.ok, outcome.reason) == (not reason, reason)
    assert bool(outcome.detail) is bool(reason)

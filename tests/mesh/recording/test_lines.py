from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from mesh.recording import InvalidLine, PackSummary, messages_in, open_objective, pack
from schemas.payloads import EMPTY, JSON, RAW, STRING, PayloadType, String

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 10**9


@pytest.mark.parametrize(
    ("line", "payload", "kind"),
    [
        ({}, b"", EMPTY),
        ({"data": None}, b"", EMPTY),
        ({"type": "std_msgs/Empty"}, b"", EMPTY),
        ({"data": "blue"}, String("blue").encode(), STRING),
        ({"data": "blå", "type": "std_msgs/String"}, String("blå").encode(), STRING),
        ({"data": {"x": 1}}, b'{"x":1}', JSON),
        ({"data": [1, 2.5, True]}, b"[1,2.5,true]", JSON),
        ({"data": 0}, b"0", JSON),
        ({"data": "text", "type": "json"}, b'"text"', JSON),
        ({"data": {}, "type": "json;Pose"}, b"{}", PayloadType("json", "Pose", "jsonschema", JSON.schema_data)),
        ({"data": "AAE=", "type": "application/octet-stream"}, b"\0\1", RAW),
        ({"data": "AAE=", "type": "ros1;my_msgs/Move"}, b"\0\1", PayloadType("ros1", "my_msgs/Move", "ros1msg")),
    ],
)
def test_what_a_line_says(line: dict[str, object], payload: bytes, kind: PayloadType) -> None:
    (message,) = messages_in([json.dumps({"topic": "/a"} | line).encode()])
    assert (message.topic, message.payload, message.type) == ("/a", payload, kind)
    assert (message.log_time_ns, message.publish_time_ns) == (0, 0)


def test_a_line_without_a_time_has_that_of_the_line_before() -> None:
    lines = [b'{"topic":"/a"}', b'{"topic":"/a","time":1.5}', b"\n", b'{"topic":"/b"}', b'{"topic":"/a","time":1}']
    assert [message.log_time_ns for message in messages_in(lines)] == [0, SECOND * 3 // 2, SECOND * 3 // 2, SECOND]


def test_times_are_right_to_the_nanosecond() -> None:
    (message,) = messages_in([b'{"topic":"/a","time":1535622771.123456789}'])
    assert message.log_time_ns == 1_535_622_771_123_456_789


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"{", "truncated"),
        (b"[]", "Expected `object`"),
        (b"\xff", "malformed"),
        (b"{}", "missing required field `topic`"),
        (b'{"topic":"/a","tiem":1}', "unknown field `tiem`"),
        (b'{"topic":"a"}', "a topic begins with /"),
        (b'{"topic":"/a b"}', "not a key"),
        (b'{"topic":"/a/**"}', "not a key"),
        (b'{"topic":"/a","time":-1}', "-1 is not a valid time"),
        (b'{"topic":"/a","time":1e99}', "is not a valid time"),
        (b'{"topic":"/a","time":"soon"}', "time"),
        (b'{"topic":"/a","data":1,"type":"std_msgs/Empty"}', "has no data"),
        (b'{"topic":"/a","data":1,"type":"std_msgs/String"}', "must be a text"),
        (b'{"topic":"/a","data":1,"type":"ros1;x/Y"}', "base64"),
        (b'{"topic":"/a","data":"?","type":"ros1;x/Y"}', "not base64"),
        (b'{"topic":"/a","data":"\\ud800"}', ""),
    ],
)
def test_a_line_that_is_no_message_is_named_by_its_number(line: bytes, why: str) -> None:
    with pytest.raises(InvalidLine) as caught:
        list(messages_in([b'{"topic":"/a"}', b"", line]))
    assert caught.value.number == 3
    assert str(caught.value).startswith("line 3: ")
    assert why in caught.value.why
    assert len(str(caught.value).splitlines()) == 1


def test_lines_become_a_recording_and_the_same_lines_the_same_bytes(tmp_path: Path) -> None:
    lines = [b'{"topic":"/b","time":2,"data":"late"}', b'{"topic":"/a","time":0.5}', b'{"topic":"/b","time":1}']
    packed = pack(messages_in(lines), tmp_path / "it.mcap")
    assert packed == PackSummary(messages=3, topics=2, duration_ns=SECOND * 3 // 2)
    played = [(one.topic, one.log_time_ns) for one in open_objective(tmp_path / "it.mcap").messages()]
    assert played == [("/a", SECOND // 2), ("/b", SECOND), ("/b", 2 * SECOND)]
    pack(messages_in(lines), tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "it.mcap").read_bytes()


def test_a_bad_line_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(InvalidLine):
        pack(messages_in([b'{"topic":"/a"}', b"?"]), tmp_path / "it.mcap")
    assert list(tmp_path.iterdir()) == []

"""Objectives from JSON lines and from ROS 1 bags."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

from mesh.errors import InputError
from mesh.recording import CorruptRecording, PackSummary, convert, messages_in, open_objective, pack
from schemas.payloads import EMPTY, JSON, RAW, STRING, PayloadType, String, payload_type
from tests.support.bags import Bag, BagMessage, Compression, string
from tests.support.raising import raises_with
from tests.support.recording.files import SECOND, T0

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("line", "payload", "kind"),
    [
        ({}, b"", EMPTY),
        ({"value": None}, b"", EMPTY),
        ({"type": "std_msgs/Empty"}, b"", EMPTY),
        ({"value": "blue"}, String("blue").encode(), STRING),
        ({"value": "blå", "type": "std_msgs/String"}, String("blå").encode(), STRING),
        ({"value": {"x": 1}}, b'{"x":1}', JSON),
        ({"value": [1, 2.5, True]}, b"[1,2.5,true]", JSON),
        ({"value": 0}, b"\0" * 8, payload_type("ros1;std_msgs/Int64")),
        ({"value": 0, "type": "json"}, b"0", JSON),
        ({"value": "text", "type": "json"}, b'"text"', JSON),
        ({"value": {}, "type": "json;Pose"}, b"{}", PayloadType("json", "Pose", "jsonschema", JSON.schema_data)),
        ({"value": "AAE=", "type": "application/octet-stream"}, b"\0\1", RAW),
        ({"value": "AAE=", "type": "ros1;my_msgs/Move"}, b"\0\1", PayloadType("ros1", "my_msgs/Move", "ros1msg")),
    ],
)
def test_a_line_becomes_a_message(line: dict[str, object], payload: bytes, kind: PayloadType) -> None:
    (message,) = messages_in([json.dumps({"topic": "/a"} | line).encode()])
    assert (message.topic, message.payload, message.type) == ("/a", payload, kind)
    assert (message.log_time_ns, message.publish_time_ns) == (0, 0)


def test_a_line_without_a_time_repeats_the_previous_one() -> None:
    lines = [b'{"topic":"/a"}', b'{"topic":"/a","time":1.5}', b"\n", b'{"topic":"/b"}', b'{"topic":"/a","time":1}']
    assert [message.log_time_ns for message in messages_in(lines)] == [0, SECOND * 3 // 2, SECOND * 3 // 2, SECOND]


def test_times_are_exact_to_the_nanosecond() -> None:
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
        (b'{"topic":"/a","value":1,"type":"std_msgs/Empty"}', "has no value"),
        (b'{"topic":"/a","value":1,"type":"std_msgs/String"}', "must be a text"),
        (b'{"topic":"/a","value":1,"type":"ros1;x/Y"}', "base64"),
        (b'{"topic":"/a","value":"?","type":"ros1;x/Y"}', "not base64"),
        (b'{"topic":"/a","value":"\\ud800"}', ""),
    ],
)
def test_an_invalid_line_is_reported_by_its_number(line: bytes, why: str) -> None:
    with raises_with(InputError, code="invalid-line") as caught:
        list(messages_in([b'{"topic":"/a"}', b"", line]))
    assert str(caught.value).startswith("line 3: ")
    assert why in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_equal_lines_make_equal_recordings(tmp_path: Path) -> None:
    lines = [b'{"topic":"/b","time":2,"value":"late"}', b'{"topic":"/a","time":0.5}', b'{"topic":"/b","time":1}']
    packed = pack(messages_in(lines), tmp_path / "it.mcap")
    assert packed == PackSummary(messages=3, topics=2, duration_ns=SECOND * 3 // 2)
    played = [(one.topic, one.log_time_ns) for one in open_objective(tmp_path / "it.mcap").messages()]
    assert played == [("/a", SECOND // 2), ("/b", SECOND), ("/b", 2 * SECOND)]
    pack(messages_in(lines), tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "it.mcap").read_bytes()


def test_a_bad_line_leaves_no_file(tmp_path: Path) -> None:
    with raises_with(InputError, code="invalid-line"):
        pack(messages_in([b'{"topic":"/a"}', b"?"]), tmp_path / "it.mcap")
    assert list(tmp_path.iterdir()) == []


SENT = [
    *(BagMessage("/blink", string(f"message {n}"), T0 + (n * 7 % 50) * SECOND) for n in range(50)),
    BagMessage("/ping", b"", T0, type="std_msgs/Empty", md5sum="d41d8cd98f00b204e9800998ecf8427e", definition=""),
]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_a_bag_is_converted_to_mcap_without_loss(tmp_path: Path, compression: Compression) -> None:
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag(SENT, compression, per_chunk=7).encode())
    path = convert(bag, tmp_path / "it.mcap", to="mcap", cid="QmTheBag").path
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros1"
        found = list(reader.iter_messages(log_time_order=False))
    assert [(channel.topic, one.log_time, one.data) for _, channel, one in found] == [
        (sent.topic, sent.time_ns, sent.payload) for sent in SENT
    ]
    for schema, channel, _ in found:
        sent = next(sent for sent in SENT if sent.topic == channel.topic)
        assert schema is not None
        assert (schema.name, schema.encoding, schema.data) == (sent.type, "ros1msg", sent.definition.encode())
        assert channel.message_encoding == "ros1"
        assert channel.metadata["md5sum"] == sent.md5sum
        assert channel.metadata["callerid"] == "/tester"
    objective = open_objective(path)
    assert objective.metadata["aira"] == {"source": "QmTheBag", "source_format": "bag"}
    played = [(one.topic, one.payload, one.log_time_ns) for one in open_objective(bag).messages()]
    assert [(one.topic, one.payload, one.log_time_ns) for one in objective.messages()] == played


def test_a_bad_bag_leaves_no_file(tmp_path: Path) -> None:
    bag = tmp_path / "it.bag"
    bag.write_bytes(Bag(SENT).encode()[:5000])
    with pytest.raises(CorruptRecording):
        convert(bag, tmp_path / "it.mcap", to="mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["it.bag"]

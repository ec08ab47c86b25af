"""Converting between MCAP, bags and rosbag2: rosbags and the decoders of `mcap` read what was written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from mesh.errors import InputError
from mesh.recording import (
    CorruptRecording,
    NotARecording,
    Played,
    Recorder,
    RecordingAbout,
    convert,
    open_objective,
    pack,
)
from mesh.recording.ros import RosTypes
from schemas.payloads import JSON, RAW, PayloadType
from tests.support.raising import raises_with
from tests.support.recording.files import SECOND, T0
from tests.support.rosbag2 import rosbag2

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording import RecordingFormat
    from schemas.payloads import Payload

POSE: dict[str, Any] = {"header": {"frame_id": "map", "stamp": {"sec": 7}}, "pose": {"position": {"x": 1.5}}}
SCAN: dict[str, Any] = {"header": {"frame_id": "laser"}, "ranges": [1.0, 2.5, 4.0], "angle_max": 3.0}
FORMATS: list[RecordingFormat] = ["mcap", "bag", "rosbag2-mcap", "rosbag2-sqlite3"]


def messages(distribution: str) -> list[tuple[str, int, Payload]]:
    ros = RosTypes(distribution)
    return [
        ("/goal", T0, ros.message("geometry_msgs/PoseStamped", **POSE)),
        ("/scan", T0 + SECOND, ros.message("sensor_msgs/LaserScan", **SCAN)),
        ("/goal", T0 + 2 * SECOND, ros.message("geometry_msgs/PoseStamped", **POSE)),
        ("/said", T0 + 3 * SECOND, ros.message("std_msgs/String", data="there")),
    ]


def source(path: Path, distribution: str) -> Path:
    """An MCAP file of ROS messages."""
    sent = messages(distribution)
    pack([Played(topic, each.data, time, time, 0, each.type) for topic, time, each in sent], path)
    return path


def read(path: Path) -> list[tuple[str, int, Any]]:
    """The messages as rosbags reads them, without what ROS 1 adds to a header."""
    with AnyReader([path]) as reader:
        return [
            (connection.topic, time, plain(reader.deserialize(raw, connection.msgtype)))
            for connection, time, raw in reader.messages()
        ]


def plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    if not hasattr(value, "__dataclass_fields__"):
        return [plain(member) for member in value] if isinstance(value, list) else value
    return {
        name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name not in ("seq", "__msgtype__")
    }


def expected() -> list[tuple[str, int, Any]]:
    ros = RosTypes("jazzy")
    return [
        (topic, time, plain(ros.decode(each.type.schema_name, each.data))) for topic, time, each in messages("jazzy")
    ]


@pytest.mark.parametrize("to", FORMATS[1:])
@pytest.mark.parametrize("distribution", ["noetic", "jazzy"])
def test_what_is_converted_is_read_by_rosbags(tmp_path: Path, distribution: str, to: RecordingFormat) -> None:
    target = tmp_path / ("it.bag" if to == "bag" else "it")
    done = convert(source(tmp_path / "source.mcap", distribution), target, to=to)

    assert (done.messages, done.duration_ns, done.left_out) == (4, 3 * SECOND, {})
    assert done.path.is_file()
    assert read(target) == expected()
    assert open_objective(done.path).count == 4
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["source.mcap", target.name])


@pytest.mark.parametrize("via", FORMATS[1:])
def test_ros_2_messages_come_back_from_each_format(tmp_path: Path, via: RecordingFormat) -> None:
    first = tmp_path / ("it.bag" if via == "bag" else "it")
    convert(source(tmp_path / "source.mcap", "jazzy"), first, to=via)
    convert(first, tmp_path / "again", to="rosbag2-mcap")
    assert read(tmp_path / "again") == expected()


def test_to_mcap_all_bytes_are_kept(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "it", messages("jazzy"), "SQLITE3")
    convert(tmp_path / "it", tmp_path / "it.mcap", to="mcap", cid="QmIt")

    made = open_objective(tmp_path / "it.mcap")
    assert made.metadata["aira"] == {"source": "QmIt", "source_format": "sqlite3"}
    before, after = (
        [(one.topic, one.log_time_ns, one.payload, one.type) for one in each.messages()]
        for each in (open_objective(path), made)
    )
    assert after == before
    assert read(tmp_path / "it.mcap") == expected()


def test_types_without_a_definition_are_those_of_the_distribution(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "it", messages("jazzy"), "SQLITE3", definitions=False)
    convert(path, tmp_path / "it.mcap", to="mcap", distribution="humble")
    assert read(tmp_path / "it.mcap") == expected()


def test_the_files_of_a_folder_are_joined(tmp_path: Path) -> None:
    path = rosbag2(tmp_path / "it", messages("jazzy"), "MCAP")
    later = [(topic, time + 9 * SECOND, each) for topic, time, each in messages("jazzy")]
    other = rosbag2(tmp_path / "other", later, "MCAP")
    path.rename(path.with_name("it_9.mcap"))
    other.rename(path.with_name("it_10.mcap"))
    convert(tmp_path / "it", tmp_path / "all.mcap", to="mcap")
    assert [row[1] for row in read(tmp_path / "all.mcap")] == [row[1] for row in (*expected(), *later)]


def test_what_can_not_be_converted_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    other = PayloadType("cdr", "own_msgs/msg/Thing", "ros2msg")
    payloads = [("/note", b"{}", JSON), ("/raw", b"x", RAW), ("/own", b"\0\1\0\0", other)]
    said = messages("jazzy")[-1][2]
    mixed = [Played(topic, data, T0, T0, 0, kind) for topic, data, kind in payloads]
    path = tmp_path / "mixed.mcap"
    pack([*mixed, Played("/said", said.data, T0, T0, 0, said.type)], path)

    with raises_with(InputError, code="unconvertible") as refused:
        convert(path, tmp_path / "it", to="rosbag2-mcap")
    assert "3 of its topics" in str(refused.value)
    assert list(tmp_path.iterdir()) == [path]

    done = convert(path, tmp_path / "it", to="rosbag2-mcap", leave_out=True)
    assert done.left_out.keys() == {"/note", "/raw", "/own"}
    assert "own_msgs/msg/Thing" in done.left_out["/own"]
    assert all(f"{topic}: {why}" in str(refused.value) for topic, why in done.left_out.items())
    assert [row[0] for row in read(tmp_path / "it")] == ["/said"]
    assert convert(path, tmp_path / "said.bag", to="bag", topics=["/s*"]).left_out == {}


def test_what_services_and_actions_say_is_converted_to_rosbag2_and_named_for_a_bag(tmp_path: Path) -> None:
    ros = RosTypes("jazzy")
    ros.register("my_robot/srv/Turn", "float32 angle\n---\nbool done")
    asked = ros.message("my_robot/srv/Turn_Request", angle=1.5)
    pack([Played("/turn/_request", asked.data, T0, T0, 0, asked.type)], tmp_path / "it.mcap")
    done = convert(tmp_path / "it.mcap", tmp_path / "it", to="rosbag2-sqlite3")
    assert [one.value for one in open_objective(done.path).messages()] == [{"angle": 1.5}]
    with raises_with(InputError, code="unconvertible") as refused:
        convert(tmp_path / "it.mcap", tmp_path / "it.bag", to="bag")
    assert "/turn/_request" in str(refused.value)


def test_a_message_that_is_not_of_its_type_is_named(tmp_path: Path) -> None:
    said = messages("jazzy")[-1][2]
    pack([Played("/said", b"\0\1\0\0\xff\xff\0\0", T0, T0, 0, said.type)], tmp_path / "it.mcap")
    with pytest.raises(CorruptRecording, match="/said"):
        convert(tmp_path / "it.mcap", tmp_path / "it.bag", to="bag")
    assert not (tmp_path / "it.bag").exists()


def test_a_folder_of_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "it").mkdir()
    with pytest.raises(NotARecording):
        convert(tmp_path / "it", tmp_path / "it.mcap", to="mcap")


def test_a_recorded_ros_2_job_is_read_message_for_message_by_others(tmp_path: Path) -> None:
    sent = messages("jazzy")
    with Recorder(tmp_path / "job.mcap", RecordingAbout(liability="0x01")) as recorder:
        for topic, time, each in sent:
            recorder.record(topic, each.data, each.type, log_time_ns=time)

    assert read(tmp_path / "job.mcap") == expected()
    with (tmp_path / "job.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        decoded = [
            (channel.topic, message.log_time, ros) for _, channel, message, ros in reader.iter_decoded_messages()
        ]
    assert [row[:2] for row in decoded] == [row[:2] for row in expected()]
    assert decoded[0][2].pose.position.x == 1.5
    assert list(decoded[1][2].ranges) == [1.0, 2.5, 4.0]
    assert decoded[3][2].data == "there"


def test_a_recording_with_other_messages_is_not_of_the_profile_ros2(tmp_path: Path) -> None:
    said = messages("jazzy")[-1][2]
    with Recorder(tmp_path / "job.mcap", RecordingAbout()) as recorder:
        recorder.record("/said", said.data, said.type)
        recorder.record("/note", msgspec.json.encode({}), JSON)
    with (tmp_path / "job.mcap").open("rb") as stream:
        assert make_reader(stream).get_header().profile == ""

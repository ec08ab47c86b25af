"""Messages of ROS 1 and ROS 2: the decoders of the `mcap` packages read them by the definitions in the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh import InvalidPayload, Payload, Recorder, RecordingAbout, RosTypes, UnknownRosType
from tests.support.recordings import decoded

if TYPE_CHECKING:
    from pathlib import Path

WHEELS = "std_msgs/Header header\nfloat64[] speeds\n"


@pytest.mark.parametrize("distribution", ["noetic", "humble"])
def test_a_message_of_any_type_is_recorded_with_its_definition(tmp_path: Path, distribution: str) -> None:
    ros = RosTypes(distribution)
    ros.register("my_robot/Wheels", WHEELS)
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"}
    sent = ros.message("my_robot/Wheels", header=header, speeds=[1.5, 2.5])

    with Recorder(tmp_path / "it.mcap", RecordingAbout()) as recorder:
        recorder.record("/wheels", sent.data, sent.type)
    ((topic, read),) = decoded(tmp_path / "it.mcap")

    assert topic == "/wheels"
    assert (read.header.frame_id, list(read.speeds)) == ("base", [1.5, 2.5])
    assert list(ros.decode("my_robot/msg/Wheels", sent.data).speeds) == [1.5, 2.5]


def test_the_type_is_that_of_the_ros_generation() -> None:
    one = RosTypes("noetic").message("std_msgs/Bool", data=True)
    two = RosTypes("humble").message("std_msgs/Bool", data=True)
    assert isinstance(one, Payload)
    assert (one.type.zenoh_encoding, one.type.schema_encoding) == ("ros1;std_msgs/Bool", "ros1msg")
    assert (two.type.zenoh_encoding, two.type.schema_encoding) == ("application/cdr;std_msgs/msg/Bool", "ros2msg")


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: RosTypes("nosuch"),
        lambda: RosTypes("humble").type("my_robot/Wheels"),
        lambda: RosTypes("humble").decode("my_robot/Wheels", b""),
        lambda: RosTypes("humble").register("my_robot/Wheels", "float64[ speeds"),
    ],
)
def test_a_type_without_a_definition_is_named(wrong: object) -> None:
    assert callable(wrong)
    with pytest.raises(UnknownRosType) as error:
        wrong()
    assert error.value.name in ("nosuch", "my_robot/Wheels")


def test_bytes_fill_an_array_of_numbers() -> None:
    ros = RosTypes("humble")
    picture = ros.message("sensor_msgs/CompressedImage", format="jpeg", data=b"\xff\xd8")
    assert ros.decode("sensor_msgs/CompressedImage", picture.data).data.tobytes() == b"\xff\xd8"


def test_fields_that_do_not_fit_are_refused() -> None:
    ros = RosTypes("humble")
    for fields in ({"linear": {"x": "far"}}, {"linear": {"a": 1}}, {"angular": 1.5}):
        with pytest.raises(InvalidPayload):
            ros.message("geometry_msgs/Twist", **fields)
    for ranges in ("far", 1):
        with pytest.raises(InvalidPayload):
            ros.message("sensor_msgs/LaserScan", ranges=ranges)
    with pytest.raises(InvalidPayload):
        ros.decode("geometry_msgs/Vector3", b"\x00\x01\x00\x00short")


@pytest.mark.parametrize("distribution", ["noetic", "humble"])
@pytest.mark.parametrize("name", ["std_msgs/Empty", "sensor_msgs/Imu", "sensor_msgs/PointCloud2", "nav_msgs/Odometry"])
def test_fields_that_are_not_given_are_zero_or_empty(distribution: str, name: str) -> None:
    ros = RosTypes(distribution)
    sent = ros.message(name)
    assert ros.encode(ros.decode(name, sent.data)) == sent

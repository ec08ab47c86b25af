"""What the mesh carries, as messages of ROS 1."""

from __future__ import annotations

import pytest

from bridges.ros1._topics import RosPayloads
from bridges.ros1.messages import Ros1Type
from mesh.recording.ros import RosTypes
from schemas import InvalidPayload
from schemas.payloads import JSON, PayloadType, encode_value


def test_a_message_of_ros_2_becomes_one_of_ros_1() -> None:
    """With a definition that reads it."""
    pytest.importorskip("rosbags")
    sent = RosTypes("jazzy").message("geometry_msgs/Twist", linear={"x": 1.5})
    payloads = RosPayloads()
    payload, kind = payloads.for_ros(sent.data, sent.type)
    assert payloads.for_ros(sent.data, sent.type) == (payload, kind)
    values = Ros1Type(kind.schema_name, kind.schema_data.decode()).decode(payload)
    assert (kind.schema_name, values["linear"]["x"]) == ("geometry_msgs/Twist", 1.5)


@pytest.mark.parametrize("name", ["my_msgs/msg/Unknown", "geometry_msgs/msg/Twist"])
def test_what_has_no_form_in_ros_1_is_refused(name: str) -> None:
    """An unknown type, and a payload that ends early."""
    pytest.importorskip("rosbags")
    with pytest.raises(InvalidPayload):
        RosPayloads().for_ros(b"\0\1\0\0abc", PayloadType("cdr", name))


def test_json_becomes_a_text() -> None:
    """ROS 1 has no type for it; numbers and texts have their own."""
    payload, kind = RosPayloads().for_ros(b'{"a":[1]}', JSON)
    assert (payload[4:], kind.schema_name) == (b'{"a":[1]}', "std_msgs/String")
    assert RosPayloads().for_ros(*encode_value(7))[1].schema_name == "std_msgs/Int64"

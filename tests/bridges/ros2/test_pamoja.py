"""Names, keys, hashes and CDR, as pamoja-ros2 has them."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridges.ros2 import RosEntity
from bridges.ros2._wire import RmwZenoh, check_name, to_dds_type
from schemas.errors import InputError
from tests.support.peers import require
from tests.support.ros2.definitions import ADD_TWO_INTS, FIBONACCI, ros_types
from tests.support.ros2.peers import HERE

TYPES = [
    "std_msgs/msg/String",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/PointCloud2",
    "nav_msgs/msg/Odometry",
    "rcl_interfaces/srv/GetParameters",
    ADD_TWO_INTS,
    f"{FIBONACCI}_SendGoal",
]
NAMES = ["/chatter", "/robot/odom", "/a/b/c", "/fibonacci/_action/send_goal", "/camera_1/image"]


def pamoja(*questions: list[Any]) -> list[Any]:
    """The answers to questions, each the name of a function and its arguments."""
    asked = "".join(json.dumps(question) + "\n" for question in questions)
    done = subprocess.run(
        [require("pamoja-ros2"), HERE / "pamoja_answers.py"], input=asked, capture_output=True, text=True, check=True
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("kind", TYPES)
def test_types_are_named_and_hashed_alike(kind: str) -> None:
    type_hash = ros_types().type_hash(kind)
    named, digest = pamoja(["dds_type_name", kind], ["type_hash_digest", type_hash])
    assert named == to_dds_type(kind)
    assert digest == type_hash.removeprefix("RIHS01_")


@pytest.mark.parametrize("name", NAMES)
def test_keys_and_tokens_have_the_same_parts(name: str) -> None:
    kind = "std_msgs/msg/String"
    type_hash = ros_types().type_hash(kind)
    key, mangled = pamoja(["entity_key", 7, name, kind, type_hash], ["percent_mangle", name])
    assert key == RmwZenoh(7).key(name, kind, type_hash)
    publisher = RosEntity("publisher", 7, "ab", 0, 1, "node", name=name, type=kind, type_hash=type_hash)
    assert RmwZenoh(7).token(publisher).split("/")[9] == mangled


def test_names_are_valid_for_both_or_for_none() -> None:
    checked: list[str] = []

    @settings(max_examples=300, database=None)
    @given(st.from_regex(r"(/[a-zA-Z_0-9~{}%]{0,4}){1,3}/?", fullmatch=True))
    @example("/a//b")
    @example("/a__b")
    @example("/_hidden")
    def gather(name: str) -> None:
        checked.append(name)

    gather()
    for name, is_valid in zip(checked, pamoja(*[["is_fully_qualified", name] for name in checked]), strict=True):
        try:
            check_name(name)
        except InputError:
            # Substitutions are resolved before a name gets into a system: here they never are.
            assert not is_valid or set(name) & set("~{}"), name
        else:
            # Repeated underscores are against the design document of ROS 2, and rmw takes them.
            assert is_valid or "__" in name, name


def test_a_message_is_encoded_to_the_same_bytes() -> None:
    linear, angular = (1.5, -2.0, 1e-300), (0.0, 3.25, -0.5)
    (encoded,) = pamoja(["twist_to_cdr", linear, angular])
    axes = ("x", "y", "z")
    fields = {"linear": dict(zip(axes, linear, strict=True)), "angular": dict(zip(axes, angular, strict=True))}
    payload = ros_types().message("geometry_msgs/msg/Twist", **fields)
    assert payload.data.hex() == (encoded if isinstance(encoded, str) else bytes(encoded).hex())

"""Own types of the peers, as their files define them."""

from __future__ import annotations

from typing import Final

from bridges.ros2._services import add_definitions
from mesh.recording.ros import RosTypes

ADD_TWO_INTS: Final = "example_interfaces/srv/AddTwoInts"
FIBONACCI: Final = "action_tutorials_interfaces/action/Fibonacci"


def ros_types(distribution: str = "jazzy") -> RosTypes:
    """The types of a distribution, and those that the peers serve."""
    types = RosTypes(distribution)
    add_definitions(types)
    types.register(ADD_TWO_INTS, "int64 a\nint64 b\n---\nint64 sum\n")
    types.register(FIBONACCI, "int32 order\n---\nint32[] sequence\n---\nint32[] partial_sequence\n")
    return types

"""Definitions of the services that every ROS 2 system has, which the package rosbags lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from mesh.ros import UnknownRosType

if TYPE_CHECKING:
    from mesh.ros import RosTypes

_CANCEL_CODES: Final = (
    "int8 ERROR_NONE=0\nint8 ERROR_REJECTED=1\nint8 ERROR_UNKNOWN_GOAL_ID=2\nint8 ERROR_GOAL_TERMINATED=3\n"
)
DEFINITIONS: Final = {
    "action_msgs/srv/CancelGoal": (
        f"GoalInfo goal_info\n---\n{_CANCEL_CODES}int8 return_code\nGoalInfo[] goals_canceling"
    ),
    "rcl_interfaces/srv/DescribeParameters": "string[] names\n---\nParameterDescriptor[] descriptors",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nParameterValue[] values",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types",
    "rcl_interfaces/srv/ListParameters": (
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nListParametersResult result"
    ),
    "rcl_interfaces/srv/SetParameters": "Parameter[] parameters\n---\nSetParametersResult[] results",
    "rcl_interfaces/srv/SetParametersAtomically": "Parameter[] parameters\n---\nSetParametersResult result",
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
}
"""The text of each service's `.srv` file, without comments."""


def add_definitions(types: RosTypes) -> None:
    """Add the services to `types`. Raises `UnknownRosType` if those are of ROS 1."""
    if not types.is_ros2:
        raise UnknownRosType(types.distribution, "it is no distribution of ROS 2")
    for name, definition in DEFINITIONS.items():
        if not types.knows(name):
            types.register(name, definition)

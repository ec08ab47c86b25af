"""ROS 2 systems over Zenoh, without ROS: `Robot` speaks rmw_zenoh, and the keys of zenoh-bridge-ros2dds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from schemas.loading import on_demand

if TYPE_CHECKING:
    from bridges.ros2.actions import RosActionServer, RosGoal
    from bridges.ros2.allowed import RosAllowed
    from bridges.ros2.errors import (
        InvalidRosName,
        InvalidRosToken,
        RosCallFailed,
        RosGoalFailed,
        RosNotAllowed,
        RosTypeMismatch,
        RosUnavailable,
        TooManyRosEndpoints,
    )
    from bridges.ros2.graph import RosGraph
    from bridges.ros2.parameters import RosParameters
    from bridges.ros2.qos import LATCHED, SENSOR_DATA, RosQos
    from bridges.ros2.robot import Robot
    from bridges.ros2.services import RosServer
    from bridges.ros2.tokens import RosEntity
    from bridges.ros2.topics import RosMessage, RosPublisher, RosSubscription

__all__ = [
    "LATCHED",
    "SENSOR_DATA",
    "InvalidRosName",
    "InvalidRosToken",
    "Robot",
    "RosActionServer",
    "RosAllowed",
    "RosCallFailed",
    "RosEntity",
    "RosGoal",
    "RosGoalFailed",
    "RosGraph",
    "RosMessage",
    "RosNotAllowed",
    "RosParameters",
    "RosPublisher",
    "RosQos",
    "RosServer",
    "RosSubscription",
    "RosTypeMismatch",
    "RosUnavailable",
    "TooManyRosEndpoints",
]

_NAMES: Final = {
    "bridges.ros2.actions": "RosActionServer RosGoal",
    "bridges.ros2.allowed": "RosAllowed",
    "bridges.ros2.errors": (
        "InvalidRosName InvalidRosToken RosCallFailed RosGoalFailed RosNotAllowed RosTypeMismatch RosUnavailable "
        "TooManyRosEndpoints"
    ),
    "bridges.ros2.graph": "RosGraph",
    "bridges.ros2.qos": "LATCHED SENSOR_DATA RosQos",
    "bridges.ros2.parameters": "RosParameters",
    "bridges.ros2.robot": "Robot",
    "bridges.ros2.services": "RosServer",
    "bridges.ros2.tokens": "RosEntity",
    "bridges.ros2.topics": "RosMessage RosPublisher RosSubscription",
}

__getattr__ = on_demand(__name__, _NAMES)

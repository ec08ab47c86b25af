"""What the programs of this example share: names, types, and a Zenoh session."""

import json
import os
from pathlib import Path

import zenoh

from mesh import RosTypes

ENDPOINT = os.environ.get("ROS2_CONNECT", "tcp/127.0.0.1:7448")
"""The router of the robot; on a real one, that of `ros2 run rmw_zenoh_cpp rmw_zenohd`."""
GOAL, CAMERA, ODOMETRY = "/patrol/goal", "/camera/image/compressed", "/odom"
NAVIGATE, ACTION = "/navigate_to_pose", "nav2_msgs/NavigateToPose"

ros = RosTypes(os.environ.get("ROS_DISTRO", "jazzy"))
ros.register(ACTION, (Path(__file__).parent / "nav2_msgs/action/NavigateToPose.action").read_text(encoding="utf-8"))


def session(mode: str, **endpoints: str) -> zenoh.Session:
    """Open a session; `connect` or `listen` is its endpoint."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for way, endpoint in endpoints.items():
        config.insert_json5(f"{way}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)

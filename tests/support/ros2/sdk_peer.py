"""zenoh-ros2-sdk in a role: `python sdk_peer.py ROLE PORT key=value …`, run by the Python that has it.

Definitions are given to it here; by itself it would fetch them with git. What it hears it prints as lines of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import zenoh_ros2_sdk
from zenoh_ros2_sdk.discovery import get_service_names_and_types, get_topic_names_and_types

STRING = ("std_msgs/msg/String", "string data")
ADD = ("example_interfaces/srv/AddTwoInts", "int64 a\nint64 b", "int64 sum")


def say(**line: object) -> None:
    """Print a line."""
    print(json.dumps(line), flush=True)


def main(role: str, port: str, *words: str) -> None:
    """Play the role until killed, or until its work is done."""
    options = dict(word.split("=", 1) for word in words)
    common = {"domain_id": int(options.get("domain", "0")), "router_port": int(port), "node_name": "sdk_node"}
    match role:
        case "talker":
            publisher = zenoh_ros2_sdk.ROS2Publisher("/chatter", *STRING, **common)
            say(ready=True, hash=publisher.type_hash)
            number = 0
            while True:
                publisher.publish(data=f"Hello {number}")
                number += 1
                time.sleep(0.05)
        case "listener":
            topic = options.get("topic", "/chatter")
            subscriber = zenoh_ros2_sdk.ROS2Subscriber(
                topic, STRING[0], lambda message: say(heard=message.data), STRING[1], **common
            )
            say(ready=True, hash=subscriber.type_hash)
        case "add-server":

            def add(request: Any) -> Any:
                say(a=request.a, b=request.b)
                return server.response_msg_class(sum=request.a + request.b)

            server = zenoh_ros2_sdk.ROS2ServiceServer("/add_two_ints", ADD[0], add, *ADD[1:], **common)
            say(ready=True, hash=server.type_hash)
        case "add-client":
            client = zenoh_ros2_sdk.ROS2ServiceClient("/add_two_ints", *ADD, **common, timeout=20.0)
            say(ready=True, hash=client.type_hash)
            response = client.call(a=int(options["a"]), b=int(options["b"]))
            say(sum=response.sum if response else None)
            return
        case "graph":
            session = zenoh_ros2_sdk.ZenohSession.get_instance(router_port=int(port))
            say(ready=True, session=session.session_id)
            while True:
                where = {key: common[key] for key in ("domain_id", "router_port")}
                say(
                    topics=dict(get_topic_names_and_types(**where)), services=dict(get_service_names_and_types(**where))
                )
                time.sleep(0.2)
    while True:
        time.sleep(1.0)


if __name__ == "__main__":
    main(*sys.argv[1:])

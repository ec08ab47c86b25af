"""A simulated ROS 2 robot, with its router: it drives to poses (action), and says where it is and what it sees.

It needs no ROS, and speaks as a robot with rmw_zenoh does.
"""

import asyncio
import math
import struct
import zlib
from typing import Any

from bridges.ros2 import Robot, RosGoal
from mesh import run_to_end
from patrol import ACTION, CAMERA, ENDPOINT, NAVIGATE, ODOMETRY, ros, session

SPEED, STEP = 4.0, 0.05  # metres a second, seconds
WIDTH, HEIGHT, SCALE = 64, 48, 8  # pixels, pixels a metre


class Rover:
    """Where it is, in metres."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.x = self.y = 0.0

    def pose(self) -> dict[str, Any]:
        return {"position": {"x": self.x, "y": self.y}, "orientation": {"w": 1.0}}

    async def drive(self, goal: RosGoal) -> dict[str, Any]:
        """Drive to the pose of a goal, straight ahead."""
        wanted = goal.request.pose.pose.position
        while (left := math.hypot(wanted.x - self.x, wanted.y - self.y)) > 0.01:
            part = min(1.0, SPEED * STEP / left)
            self.x += part * (wanted.x - self.x)
            self.y += part * (wanted.y - self.y)
            pose = {"header": {"frame_id": "map"}, "pose": self.pose()}
            goal.feedback({"current_pose": pose, "distance_remaining": (1 - part) * left})
            self.say()
            await asyncio.sleep(STEP)
        return {"error_code": 0}

    def say(self) -> None:
        self.robot.publish(
            ODOMETRY, "nav_msgs/Odometry", {"header": {"frame_id": "map"}, "pose": {"pose": self.pose()}}
        )
        self.robot.publish(CAMERA, "sensor_msgs/CompressedImage", {"format": "png", "data": self.picture()})

    def picture(self) -> bytes:
        """A map with the rover on it, as a PNG."""
        column, row = round(WIDTH / 2 + SCALE * self.x), round(HEIGHT / 2 - SCALE * self.y)
        lines = [[255 * (abs(x - column) < 3 and abs(y - row) < 3) for x in range(WIDTH)] for y in range(HEIGHT)]
        head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 0, 0, 0, 0)
        data = zlib.compress(b"".join(b"\0" + bytes(line) for line in lines))
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            _chunk(*each) for each in ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
        )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


async def main() -> None:
    async with Robot(await asyncio.to_thread(session, "router", listen=ENDPOINT), ros, node="rover") as robot:
        rover = Rover(robot)
        robot.serve_action(NAVIGATE, ACTION, rover.drive)
        print(f"the rover drives; its router is {ENDPOINT}", flush=True)
        while True:
            rover.say()
            await asyncio.sleep(0.2)


if __name__ == "__main__":
    run_to_end(main)

"""The patrol: a simulated ROS 2 robot drives to poses for money; others open its recording."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING, Any

import pytest
from rosbags.highlevel import AnyReader

from mesh.recording import open_objective
from schemas import cid_of_file
from tests.support.commands import AIRA, Serving, aira, run
from tests.support.lessons import EXAMPLES, as_role, market
from tests.support.ports import free_port
from tests.support.recordings import decoded

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["market"]

EXAMPLE = EXAMPLES / "ros2_patrol"
PLACES = ((1.0, 0.0), (1.0, 1.0))


@pytest.mark.full
def test_a_ros_2_robot_drives_to_poses_for_money(market: dict[str, str], tmp_path: Path) -> None:
    ros = {"ROS2_CONNECT": f"tcp/127.0.0.1:{free_port()}"}
    robot, person = as_role("robot", market) | ros, as_role("person", market)
    objective, out = tmp_path / "patrol.mcap", tmp_path / "result.mcap"
    assert run(sys.executable, EXAMPLE / "goals.py", objective, *(f"{x},{y}" for x, y in PLACES)).returncode == 0
    with (
        Serving(sys.executable, EXAMPLE / "rover.py", says="the rover drives", variables=ros) as rover,
        Serving(sys.executable, EXAMPLE / "robot.py", says="account 0x", variables=robot) as agent,
    ):
        terms = ("--cost", "5 XRT", "--model", cid_of_file(EXAMPLE / "robot.py"), "--objective", objective)
        done = run(*AIRA, "demand", *terms, "--out", out, **person)
        assert "paid" in done.stdout, done.stderr + agent.log() + rover.log()
        (contract,) = re.findall(r"^contract (0x\w{40})", done.stdout, re.MULTILINE)
        verified = aira("verify", contract, **person)
        assert verified.returncode == 0, verified.stdout + verified.stderr

    messages = [(one.topic, one.payload) for one in open_objective(out).messages()]
    feedback = [topic for topic, _ in messages if topic == "/navigate_to_pose/_action/feedback"]
    pictures = [payload for topic, payload in messages if topic == "/camera/image/compressed"]
    assert len(feedback) > 5
    assert all(b"\x89PNG\r\n\x1a\n" in picture for picture in pictures)
    assert pictures
    with AnyReader([out]) as reader:
        theirs: list[Any] = [
            (each.topic, bytes(raw), reader.deserialize(raw, each.msgtype)) for each, _, raw in reader.messages()
        ]
    assert [(topic, raw) for topic, raw, _ in theirs] == messages
    goals = [one.pose.position for topic, _, one in theirs if topic == "/patrol/goal"]
    assert [(goal.x, goal.y) for goal in goals] == list(PLACES)
    assert len(decoded(out)) == len(messages)

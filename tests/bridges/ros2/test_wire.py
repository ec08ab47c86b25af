"""All that we send, as a listener without our code hears it: a process of ROS 2 ends if an attachment is malformed."""

from __future__ import annotations

import asyncio
import re
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import xxhash
import zenoh
from zenoh.ext import Int64, UInt8, z_deserialize

from bridges.ros2 import LATCHED, Robot
from tests.support.ros2.definitions import ADD_TWO_INTS, FIBONACCI, ros_types
from tests.support.ros2.tap import Tap
from tests.support.waiting import until

if TYPE_CHECKING:
    from bridges.ros2 import RosGoal
    from tests.support.routers import EmbeddedRouter

NAME = r"(%[A-Za-z_][A-Za-z0-9_]*)+"
TYPE = r"[a-z][a-z0-9_]*::(msg|srv|action)::dds_::[A-Za-z0-9_]+_"
HASH = r"RIHS01_[0-9a-f]{64}"
QOS = r"[12]:[12]:[12],[0-9]+:,:,:,,"
NODE = rf"@ros2_lv/0/[0-9a-f]{{1,32}}/\d+/\d+/NN/%/(%|{NAME})/[A-Za-z0-9_]+"
ENDPOINT = rf"@ros2_lv/0/[0-9a-f]{{1,32}}/\d+/\d+/(MP|MS|SS|SC)/%/(%|{NAME})/[A-Za-z0-9_]+/{NAME}/{TYPE}/{HASH}/{QOS}"


async def _add(request: Any) -> dict[str, int]:
    return {"sum": request.a + request.b}


async def _count(goal: RosGoal) -> dict[str, list[int]]:
    for number in range(goal.request.order):
        goal.feedback({"partial_sequence": [number]})
    return {"sequence": [1]}


async def _use_everything(robot: Robot, other: Robot) -> None:
    """Each kind of message, request and reply, several times."""
    robot.serve("/add", ADD_TWO_INTS, _add)
    robot.serve_action("/count", FIBONACCI, _count)
    for number in range(5):
        robot.publish("/chatter", "std_msgs/msg/String", {"data": "x" * number})
        robot.publish("/map", "std_msgs/msg/String", {"data": "y" * number}, qos=LATCHED)
        robot.publish("/cmd_vel", "geometry_msgs/msg/Twist", {"linear": {"x": float(number)}})
        await other.call("/add", ADD_TWO_INTS, {"a": number, "b": 1})
        await other.action("/count", FIBONACCI, {"order": number}, timeout=20)


async def test_keys_tokens_attachments_and_payloads_are_as_ros_2_takes_them(
    router: EmbeddedRouter, here: zenoh.Session, there: zenoh.Session
) -> None:
    tap = await asyncio.to_thread(lambda: Tap(router.endpoint, limit=1000))
    try:
        async with Robot(here, ros_types(), node="ours") as robot, Robot(there, ros_types(), namespace="/far") as other:
            await _use_everything(robot, other)
            await until(lambda: sum("/chatter/" in one["key"] for one in tap.heard["samples"]) == 5, what="all samples")
            heard, tokens = tap.heard["samples"] + tap.heard["requests"], set(tap.tokens)
    finally:
        tap.close()
    assert len(tokens) > 12
    for token in tokens:
        assert re.fullmatch(NODE if "/NN/" in token else ENDPOINT, token), token
    gids = {xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little") for token in tokens}
    sequences: dict[bytes, list[int]] = defaultdict(list)
    types = ros_types()
    for one in heard:
        domain, *_, kind, type_hash = one["key"].split("/")
        name = kind.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
        assert domain == "0"
        assert types.type_hash(name) == type_hash
        attachment = bytes.fromhex(one["attachment"])
        assert len(attachment) == 33
        sequence, time_ns, gid = z_deserialize(tuple[Int64, Int64, list[UInt8]], zenoh.ZBytes(attachment))
        assert time_ns > 1_700_000_000 * 10**9
        assert bytes(gid) in gids
        sequences[bytes(gid)].append(sequence)
        payload = bytes.fromhex(one["payload"])
        assert payload[:4] == b"\0\1\0\0"
        types.decode(name + ("_Request" if one in tap.heard["requests"] else ""), payload)
    for counted in sequences.values():
        assert sorted(counted) == list(range(1, len(counted) + 1))

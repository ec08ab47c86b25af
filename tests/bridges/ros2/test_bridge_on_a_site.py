"""The bridge to ROS 2 as a member of a site with the role edge: what it needs is granted, and nothing of a market."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from bridges.ros2 import Robot, RosAllowed
from bridges.ros2._bridge import RosBridge
from mesh import RosTypes
from mesh.base.background import Background
from mesh.network import Endpoints, Network
from mesh.ops.identity.roster import Member
from schemas.keys import DeviceTopicKey, EventKey, LiabilityTopicKey, ObjectiveTopicKey
from tests.support.routers import EmbeddedRouter
from tests.support.sites import Site
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

AGENT, BRIDGE, JOB = "0x" + "11" * 20, "0x" + "33" * 20, "0x" + "22" * 20
TWIST = "geometry_msgs/Twist"


async def test_its_role_grants_what_a_job_needs(tmp_path: Path) -> None:
    site, ros, said = Site(tmp_path), RosTypes("jazzy"), set[str]()
    agent = site.enlist(Member(name="rover", address=AGENT, roles=("agent",)))
    member = site.enlist(Member(name="robot", address=BRIDGE, roles=("edge",), agent=AGENT))
    allow = RosAllowed(publish=("/cmd_vel",), subscribe=("/odom",))
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        stack.enter_context(site.open_router("wheel"))
        field = Endpoints(connect=(stack.enter_context(EmbeddedRouter()).endpoint,))
        ours = (await enter(Network(site.client(agent)))).session
        mesh = (await enter(Network(site.client(member)))).session
        rover = await enter(Robot((await enter(Network(field))).session, ros, node="rover"))
        bridge = await enter(RosBridge(mesh, (await enter(Network(field))).session, ros, allow, agent=AGENT))
        (await enter(Background())).start(bridge.run(), "bridge of the test")
        heard = await enter(rover.subscribe("/cmd_vel", TWIST))
        ours.declare_subscriber(f"aira/agent/{AGENT}/**", lambda sample: said.add(str(sample.key_expr)))
        odometry, twist = rover.advertise("/odom", TWIST), ros.message(TWIST, linear={"x": 0.5})

        def is_said(key: object) -> bool:
            odometry.put(twist)
            return str(key) in said

        await until(lambda: is_said(DeviceTopicKey(AGENT, "robot", "/odom")), pause=0.1)
        ours.put(str(EventKey(AGENT, JOB, "ready")), b"{}")
        await until(lambda: is_said(LiabilityTopicKey(AGENT, JOB, "/odom")), pause=0.1)
        ours.put(str(ObjectiveTopicKey(AGENT, JOB, "/cmd_vel")), twist.data, encoding=twist.type.zenoh_encoding)
        async with asyncio.timeout(20):
            assert (await anext(heard)).payload.data == twist.data

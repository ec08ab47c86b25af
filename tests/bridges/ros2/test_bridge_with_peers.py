"""The bridge as a process, between a mesh and other ROS 2 systems."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pytest

from schemas.keys import DeviceTopicKey
from tests.support.commands import AIRA, Serving
from tests.support.ros2.definitions import ros_types
from tests.support.ros2.peers import RosPeer, hiroz, sdk
from tests.support.routers import EmbeddedRouter
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable

    import zenoh

AGENT: Final = "0x" + "11" * 20
STRING: Final = "std_msgs/msg/String"


@pytest.mark.parametrize("peer", [hiroz, sdk], ids=["hiroz", "sdk"])
async def test_the_bridge_carries_a_peers_topics_and_gives_it_ours(
    peer: Callable[..., RosPeer], router: EmbeddedRouter, here: zenoh.Session
) -> None:
    heard: list[bytes] = []
    here.declare_subscriber(
        str(DeviceTopicKey(AGENT, "robot", "/chatter")), lambda one: heard.append(bytes(one.payload))
    )
    types = ros_types()
    with EmbeddedRouter() as field:
        options = ("--connect", router.endpoint, "--ros2-connect", field.endpoint, "--subscribe", "/chatter")
        bridge = Serving(*AIRA, "bridge", "ros2", "--agent", AGENT, *options, "--publish", "/said", says="bridge of 0x")
        async with bridge, peer("talker", field.endpoint), peer("listener", field.endpoint, topic="/said") as listener:
            await until(lambda: len(heard) > 5, what="the talker's messages")
            texts = [types.decode(STRING, payload).data for payload in heard]
            assert all(text.startswith("Hello ") for text in texts)
            payload = types.message(STRING, data="from the mesh")
            key = str(DeviceTopicKey(AGENT, "robot", "/said"))
            publisher = here.declare_publisher(key, encoding=payload.type.zenoh_encoding)
            await until(lambda: publisher.matching_status.matching, what="the bridge")  # type: ignore[attr-defined]
            publisher.put(payload.data)
            assert await listener.line("heard") == "from the mesh"

"""Topics of other ROS 2 systems, in both directions."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ros2 import LATCHED, Robot, RosQos
from mesh.network import Endpoints, Network
from tests.support.ros2.definitions import ADD_TWO_INTS, FIBONACCI, ros_types
from tests.support.ros2.peers import RosPeer, hiroz, sdk
from tests.support.routers import Zenohd
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from tests.support.routers import EmbeddedRouter

    OurRobot = Callable[..., AbstractAsyncContextManager[Robot]]

STRING = "std_msgs/msg/String"
PEERS = pytest.mark.parametrize("peer", [hiroz, sdk], ids=["hiroz", "sdk"])


@PEERS
async def test_messages_of_a_peer_are_heard_with_number_time_and_sender(
    peer: Callable[..., RosPeer], router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with peer("talker", router.endpoint), our_robot() as robot, robot.subscribe("/chatter") as messages:
        heard = [await anext(messages) for _ in range(3)]
    texts = [robot.types.decode(STRING, message.payload.data).data for message in heard]
    first = int(texts[0].split()[1])
    assert texts == [f"Hello {first + number}" for number in range(3)]
    assert [message.sequence - heard[0].sequence for message in heard] == [0, 1, 2]
    assert sorted(message.source_time_ns for message in heard) == [message.source_time_ns for message in heard]
    assert {len(message.gid) for message in heard} == {16}
    assert len({message.gid for message in heard}) == 1
    assert heard[0].payload.type.schema_name == STRING
    assert b"string data" in heard[0].payload.type.schema_data


@PEERS
async def test_a_peer_hears_our_messages(
    peer: Callable[..., RosPeer], router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with peer("listener", router.endpoint, depth=100) as listener, our_robot() as robot:
        await robot.ready("/chatter")
        robot.advertise("/chatter", STRING)
        for number in range(50):
            robot.publish("/chatter", STRING, {"data": f"ours {number}"})
        assert [await listener.line("heard") for _ in range(50)] == [f"ours {number}" for number in range(50)]
        assert listener.is_alive


async def test_peers_that_link_directly_are_heard_and_hear_through_their_router() -> None:
    # As processes of ROS 2 do by default: they find each other through the router, which also serves the clients.
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": True}, "delay": 0}
    async with Zenohd(
        config={"scouting": scouting, "routing": {"router": {"peers_failover_brokering": True}}}
    ) as router:
        talker = hiroz("talker", router.endpoint, mode="peer", topic="/theirs")
        listener = hiroz("listener", router.endpoint, mode="peer", topic="/ours", depth=100)
        neighbour = hiroz("listener", router.endpoint, mode="peer", topic="/theirs", node="neighbour")
        async with (
            talker,
            listener,
            neighbour,
            Network(Endpoints(connect=(router.endpoint,))) as network,
            Robot(network.session, ros_types()) as robot,
            robot.subscribe("/theirs") as messages,
        ):
            numbers = [(await anext(messages)).sequence for _ in range(20)]
            assert numbers == list(range(numbers[0], numbers[0] + 20))
            assert (await neighbour.line("heard")).startswith("Hello ")
            await robot.ready("/ours")
            for number in range(20):
                robot.publish("/ours", STRING, {"data": f"{number}"})
            assert [await listener.line("heard") for _ in range(20)] == [f"{number}" for number in range(20)]


@pytest.mark.parametrize("distribution", ["jazzy", "humble"])
async def test_a_distribution_without_hashes_is_spoken_to_without_them(
    distribution: str, router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    talker = hiroz("talker", router.endpoint, distribution=distribution, topic="/theirs")
    listener = hiroz("listener", router.endpoint, distribution=distribution, topic="/ours")
    async with talker, listener, our_robot(ros_types(distribution)) as robot, robot.subscribe("/theirs") as messages:
        assert robot.types.decode(STRING, (await anext(messages)).payload.data).data.startswith("Hello ")
        await robot.ready("/ours")
        robot.publish("/ours", STRING, {"data": "one"})
        assert await listener.line("heard") == "one"


async def test_our_late_subscription_gets_what_a_transient_local_publisher_kept(
    router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    options = {"durability": "transient_local", "depth": 3, "count": 5, "period": 1}
    async with hiroz("talker", router.endpoint, **options) as talker, our_robot() as robot:
        await talker.line("published")
        async with robot.subscribe("/chatter") as messages:
            heard = [robot.types.decode(STRING, (await anext(messages)).payload.data).data for _ in range(3)]
    assert sorted(heard) == ["Hello 2", "Hello 3", "Hello 4"]


async def test_a_peers_late_subscription_gets_what_our_transient_local_publisher_kept(
    router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with our_robot() as robot:
        for number in range(3):
            robot.publish("/map_name", STRING, {"data": f"map {number}"}, qos=LATCHED)
        options = {"durability": "transient_local", "depth": 1, "topic": "/map_name"}
        async with hiroz("listener", router.endpoint, **options) as listener:
            assert await listener.line("heard") == "map 2"
            robot.publish("/map_name", STRING, {"data": "map 3"})
            assert await listener.line("heard") == "map 3"


async def test_namespaces_and_domains_are_kept_apart(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    options = {"namespace": "/fleet/one", "node": "scout", "domain": 5, "topic": "chatter"}
    async with hiroz("talker", router.endpoint, **options), our_robot() as elsewhere, our_robot(domain=5) as robot:
        await robot.ready("/fleet/one/chatter")
        assert "/fleet/one/scout" in robot.graph.nodes()
        assert robot.graph.topics()["/fleet/one/chatter"] == [STRING]
        async with robot.subscribe("/fleet/one/chatter") as messages:
            assert (await anext(messages)).topic == "/fleet/one/chatter"
        assert "/fleet/one/scout" not in elsewhere.graph.nodes()


async def test_the_quality_of_service_of_a_peer_is_seen(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    options = {"durability": "transient_local", "reliability": "best_effort", "depth": 7}
    async with hiroz("talker", router.endpoint, **options), our_robot() as robot:
        await robot.ready("/chatter")
        (publisher,) = robot.graph.find("/chatter", "publisher")
        assert publisher.qos == RosQos(7, "best-effort", "transient-local")


async def test_what_a_peer_has_is_in_our_graph_until_it_goes(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        async with hiroz("fibonacci-server", router.endpoint, node="mathematician"):
            await robot.ready("/fibonacci")
            await until(lambda: "/fibonacci" in robot.graph.actions(), what="the action")
            assert robot.graph.actions()["/fibonacci"] == ["action_tutorials_interfaces/action/Fibonacci"]
            assert "/mathematician" in robot.graph.nodes()
            await until(lambda: "/mathematician/get_parameters" in robot.graph.services(), what="its services")
        await until(lambda: "/mathematician" not in robot.graph.nodes(), what="the node's end")
        await until(lambda: robot.graph.actions() == {}, what="the action's end")


async def test_a_peer_sees_our_node_and_what_it_has_until_we_go(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async def refuse(_: object) -> None:
        raise ValueError

    async with hiroz("graph", router.endpoint) as graph:
        async with our_robot(node="ours", namespace="/mesh") as robot:
            robot.advertise("/cmd_vel", "geometry_msgs/msg/Twist")
            robot.serve("/add", ADD_TWO_INTS, refuse)
            robot.serve_action("/count", FIBONACCI, refuse)
            wanted = {"/add", "/count/_action/send_goal"}
            seen = await _graph(
                graph, lambda seen: "/count" in dict(seen["actions"]) and wanted <= dict(seen["services"]).keys()
            )
            assert ["ours", "/mesh"] in seen["nodes"]
            assert dict(seen["topics"])["/cmd_vel"] == "geometry_msgs::msg::dds_::Twist_"
            assert dict(seen["services"])["/add"] == "example_interfaces::srv::dds_::AddTwoInts_"
            assert "/count" in dict(seen["actions"])
        await _graph(graph, lambda seen: ["ours", "/mesh"] not in seen["nodes"])
    async with our_robot() as robot:
        robot.advertise("/cmd_vel", "geometry_msgs/msg/Twist")
        robot.serve("/add", ADD_TWO_INTS, refuse)
        async with sdk("graph", router.endpoint) as graph:
            seen = await _graph(graph, lambda seen: "/add" in seen["services"] and "/cmd_vel" in seen["topics"])
            assert seen["topics"]["/cmd_vel"] == ["geometry_msgs/msg/Twist"]
            assert seen["services"]["/add"] == [ADD_TWO_INTS]


MESSAGES: dict[str, dict[str, Any]] = {
    "std_msgs/msg/String": {"data": "grüße"},
    "std_msgs/msg/Header": {"stamp": {"sec": -1, "nanosec": 5}, "frame_id": "map"},
    "std_msgs/msg/Float64MultiArray": {
        "layout": {"dim": [{"label": "x", "size": 2, "stride": 2}], "data_offset": 1},
        "data": [0.5, -2.0],
    },
    "geometry_msgs/msg/Twist": {"linear": {"x": 1.5}, "angular": {"z": -0.25}},
    "geometry_msgs/msg/PoseStamped": {"header": {"frame_id": "abc"}, "pose": {"position": {"y": 2.0}}},
    "nav_msgs/msg/Odometry": {
        "header": {"frame_id": "o"},
        "child_frame_id": "base",
        "pose": {"covariance": [0.5] * 36},
    },
    "nav_msgs/msg/Path": {"poses": [{"header": {"frame_id": "a"}}, {"pose": {"position": {"x": 9.0}}}]},
    "sensor_msgs/msg/LaserScan": {"range_max": 3.5, "ranges": [1.0, 2.0, 3.0], "intensities": []},
    "sensor_msgs/msg/JointState": {"name": ["a", "bcd", ""], "position": [1.0], "effort": [-1.0, 2.0]},
    "sensor_msgs/msg/Image": {"height": 1, "width": 3, "encoding": "rgb8", "step": 9, "data": bytes(range(9))},
    "sensor_msgs/msg/BatteryState": {"voltage": 12.5, "present": True, "cell_voltage": [4.0], "location": "x"},
    "sensor_msgs/msg/PointCloud2": {"fields": [{"name": "x", "datatype": 7, "count": 1}], "data": b"\1\2\3"},
    "rcl_interfaces/msg/ParameterEvent": {"node": "/n", "new_parameters": [{"name": "p", "value": {"type": 2}}]},
}


@pytest.mark.parametrize("kind", MESSAGES)
async def test_a_message_that_a_peer_decodes_and_encodes_again_has_the_same_bytes(
    kind: str, router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with hiroz("echo", router.endpoint, type=kind) as echo, our_robot() as robot:
        await robot.ready("/in")
        async with robot.subscribe("/out") as messages:
            sent = robot.types.message(kind, **MESSAGES[kind])
            robot.publish("/in", sent)
            async with asyncio.timeout(30):
                answered = await anext(messages)
        assert answered.payload.data == sent.data
        assert echo.is_alive


async def test_a_large_message_is_carried_whole(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    kind = "sensor_msgs/msg/Image"
    async with hiroz("echo", router.endpoint, type=kind), our_robot() as robot:
        await robot.ready("/in")
        async with robot.subscribe("/out") as messages:
            sent = robot.types.message(kind, height=1000, width=1500, step=4500, data=bytes(range(250)) * 18_000)
            robot.publish("/in", sent)
            async with asyncio.timeout(30):
                assert (await anext(messages)).payload.data == sent.data


async def test_a_subscription_goes_on_when_its_publisher_or_the_router_starts_again(
    router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with our_robot() as robot:
        senders = []
        async with hiroz("talker", router.endpoint), robot.subscribe("/chatter") as messages:
            senders.append((await anext(messages)).gid)
            await asyncio.to_thread(router.stop)
            await asyncio.to_thread(router.start)
            started = time.time_ns()
            async with asyncio.timeout(30):
                while (await anext(messages)).source_time_ns < started:
                    pass
        async with robot.subscribe("/chatter", STRING) as messages, hiroz("talker", router.endpoint):
            async with asyncio.timeout(30):
                senders.append((await anext(messages)).gid)
            await until(lambda: len(robot.graph.find("/chatter", "publisher")) == 1, what="the new talker alone")
        assert len(set(senders)) == 2


async def _graph(peer: RosPeer, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first graph that a peer prints for which the condition is true."""
    async with asyncio.timeout(30):
        while not condition(seen := await peer.next_line()):
            pass
    return seen

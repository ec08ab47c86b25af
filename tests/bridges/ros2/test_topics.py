"""Topics and discovery, between two nodes of ours on a real router."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import pytest

from bridges.ros2 import LATCHED, SENSOR_DATA, Robot, RosAllowed, RosError, RosQos
from bridges.ros2._node import GRAPH_LIMITS
from bridges.ros2._services import ROBOT_LIMITS
from bridges.ros2._wire import PREFIX, RmwZenoh, gid_of, parse_attachment
from mesh import InvalidPayload, RosTypes, UnknownRosType
from mesh.base.flood import Drops
from mesh.errors import ConfigurationError, InputError
from schemas import Payload
from schemas.payloads import STRING
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zenoh

    from tests.support.routers import EmbeddedRouter

STRING_TYPE: Final = "std_msgs/msg/String"


async def heard(messages: Any, number: int) -> list[Any]:
    async with asyncio.timeout(20):
        return [await anext(messages) for _ in range(number)]


def text(message: Any) -> str:
    return str(RosTypes("jazzy").decode(STRING_TYPE, message.payload.data).data)


async def test_both_sides_see_each_other(here: zenoh.Session, there: zenoh.Session, domain: int) -> None:
    async with (
        Robot(here, RosTypes("jazzy"), domain=domain) as ours,
        Robot(there, RosTypes("jazzy"), domain=domain, node="talker", namespace="/robot") as talker,
    ):
        talker.advertise("chatter", "std_msgs/String")
        await ours.ready("/robot/chatter")
        await until(lambda: "/aira" in talker.graph.nodes())

        assert {"/aira", "/robot/talker"} <= set(ours.graph.nodes())
        assert ours.graph.topics() == {"/robot/chatter": [STRING_TYPE]}


async def test_what_leaves_is_forgotten(here: zenoh.Session, there: zenoh.Session, domain: int) -> None:
    async with Robot(here, RosTypes("jazzy"), domain=domain) as ours:
        async with Robot(there, RosTypes("jazzy"), domain=domain, node="talker") as talker:
            talker.advertise("/chatter", "std_msgs/String")
            await ours.ready("/chatter")
        await until(lambda: ours.graph.nodes() == ["/aira"])
        await until(lambda: ours.graph.topics() == {}, what="the topic's end")
        with raises_with(RosError, code="ros-unavailable") as error:
            await ours.ready("/chatter", timeout=0.05)
        assert str(error.value).startswith("/chatter: ")


@pytest.mark.parametrize("flavour", ["rmw_zenoh", "ros2dds"])
@pytest.mark.parametrize("distribution", ["jazzy", "humble"])
async def test_messages_reach_a_subscription_whose_type_is_discovered(
    here: zenoh.Session, there: zenoh.Session, domain: int, flavour: Any, distribution: str
) -> None:
    ros = RosTypes(distribution)
    async with (
        Robot(here, ros, domain=domain, flavour=flavour) as ours,
        Robot(there, RosTypes(distribution), domain=domain, node="talker", flavour=flavour) as talker,
    ):
        talker.advertise(f"/chatter{domain}", "std_msgs/String")
        async with ours.subscribe(f"/chatter{domain}") as messages:
            await talker.ready(f"/chatter{domain}")
            for number in range(3):
                talker.publish(f"/chatter{domain}", ros.message("std_msgs/String", data=f"Hello {number}"))
            received = await heard(messages, 3)

    assert [text(message) for message in received] == ["Hello 0", "Hello 1", "Hello 2"]
    assert received[0].payload.type == ros.payload_type("std_msgs/String")
    if flavour == "rmw_zenoh":
        assert [message.sequence for message in received] == [1, 2, 3]
        assert len({message.gid for message in received}) == 1
        assert received[0].source_time_ns <= received[2].source_time_ns


async def test_each_sample_has_what_rmw_zenoh_requires(here: zenoh.Session, there: zenoh.Session, domain: int) -> None:
    ros = RosTypes("jazzy")
    samples: list[zenoh.Sample] = []
    key = RmwZenoh(domain).key("/chatter", STRING_TYPE, ros.type_hash(STRING_TYPE))
    with there.declare_subscriber(key, samples.append):
        async with Robot(here, ros, domain=domain) as ours:
            publisher = ours.advertise("/chatter", "std_msgs/String")
            await until(lambda: publisher.is_heard)
            ours.publish("/chatter", "std_msgs/String", {"data": "Hello"})
            await until(lambda: samples)
            (entity,) = ours.graph.find("/chatter", "publisher")

    token = RmwZenoh(domain).token(entity)
    attached = parse_attachment(samples[0].attachment.to_bytes())  # type: ignore[union-attr]
    assert attached is not None
    assert (attached.sequence, attached.gid) == (1, gid_of(token))
    assert samples[0].payload.to_bytes().hex() == "000100000600000048656c6c6f00"


async def test_malformed_samples_are_dropped_and_counted(
    here: zenoh.Session, there: zenoh.Session, domain: int
) -> None:
    ros, drops = RosTypes("jazzy"), Drops()
    key = RmwZenoh(domain).key("/chatter", STRING_TYPE, ros.type_hash(STRING_TYPE))
    good = bytes.fromhex("000100000600000048656c6c6f00")
    async with (
        Robot(here, ros, domain=domain, drops=drops) as ours,
        Robot(there, ros, domain=domain, node="talker") as talker,
        ours.subscribe("/chatter", "std_msgs/String") as messages,
    ):
        await talker.ready("/chatter")
        there.put(key, good)
        there.put(key, good, attachment=b"\0" * 33)
        there.put(key, b"\1\2", attachment=b"\0" * 16 + b"\x10" + b"\0" * 16)
        there.put(key, good, attachment=b"\0" * 16 + b"\x10" + b"\0" * 16)
        (message,) = await heard(messages, 1)

    assert text(message) == "Hello"
    assert drops.totals() == {"bad-attachment": 2, "bad-cdr": 1}


@pytest.mark.parametrize("flavour", ["rmw_zenoh", "ros2dds"])
async def test_late_subscriptions_get_what_is_kept(
    here: zenoh.Session, there: zenoh.Session, domain: int, flavour: Any
) -> None:
    name = f"/map{domain}"
    async with (
        Robot(here, RosTypes("jazzy"), domain=domain, flavour=flavour) as ours,
        Robot(there, RosTypes("jazzy"), domain=domain, node="server", flavour=flavour) as server,
    ):
        for number in range(5):
            server.publish(
                name, "std_msgs/String", {"data": f"{number}"}, qos=RosQos(depth=2, durability="transient-local")
            )
        async with ours.subscribe(name) as messages:
            kept = await heard(messages, 2)
            server.publish(name, "std_msgs/String", {"data": "new"})
            kept += await heard(messages, 1)

    assert [text(message) for message in kept] == ["3", "4", "new"]


async def test_a_late_publisher_is_found_by_a_subscription(
    here: zenoh.Session, there: zenoh.Session, domain: int
) -> None:
    async with (
        Robot(here, RosTypes("jazzy"), domain=domain) as ours,
        ours.subscribe("/map", "std_msgs/String", qos=LATCHED) as messages,
        Robot(there, RosTypes("jazzy"), domain=domain, node="server") as server,
    ):
        server.publish("/map", "std_msgs/String", {"data": "it"}, qos=LATCHED)
        (message,) = await heard(messages, 1)

    assert text(message) == "it"


async def test_only_what_is_allowed_is_carried(here: zenoh.Session, domain: int) -> None:
    allow = RosAllowed(publish=("/cmd_*",), subscribe=("/camera/*",))
    async with Robot(here, RosTypes("jazzy"), domain=domain, allow=allow) as ours:
        ours.publish("/cmd_vel", "geometry_msgs/Twist", {"linear": {"x": 1.0}})
        ours.subscribe("/camera/image", "sensor_msgs/Image")
        with raises_with(ConfigurationError, code="ros-not-allowed") as published:
            ours.publish("/other", "std_msgs/String", {"data": ""})
        with raises_with(ConfigurationError, code="ros-not-allowed") as subscribed:
            ours.subscribe("/odom")

    assert str(published.value) == "/other: not allowed to publish"
    assert str(subscribed.value) == "/odom: not allowed to subscribe"


async def test_another_definition_of_a_type_is_noticed(here: zenoh.Session, there: zenoh.Session, domain: int) -> None:
    one, other = RosTypes("jazzy"), RosTypes("jazzy")
    one.register("my_robot/Wheels", "float64[] speeds\n")
    other.register("my_robot/Wheels", "float32[] speeds\n")
    async with (
        Robot(here, one, domain=domain) as ours,
        Robot(there, other, domain=domain, node="talker") as talker,
    ):
        talker.advertise("/wheels", "my_robot/Wheels")
        await ours.ready("/wheels")
        with raises_with(RosError, code="ros-type-mismatch"):
            async with ours.subscribe("/wheels", "my_robot/Wheels"):
                pass


async def test_an_unknown_type_is_received_without_its_definition(
    here: zenoh.Session, there: zenoh.Session, domain: int
) -> None:
    ros = RosTypes("jazzy")
    ros.register("my_robot/Wheels", "float64[] speeds\n")
    async with (
        Robot(here, RosTypes("jazzy"), domain=domain) as ours,
        Robot(there, ros, domain=domain, node="talker") as talker,
    ):
        talker.advertise("/wheels", "my_robot/Wheels")
        async with ours.subscribe("/wheels") as messages:
            await talker.ready("/wheels")
            talker.publish("/wheels", "my_robot/Wheels", {"speeds": [1.0]})
            (message,) = await heard(messages, 1)

    assert message.payload.type.schema_name == "my_robot/msg/Wheels"
    assert message.payload.type.schema_data == b""
    assert list(ros.decode("my_robot/Wheels", message.payload.data).speeds) == [1.0]


def unfit(ros: RosTypes) -> Iterator[Payload]:
    kind = ros.payload_type("std_msgs/String")
    yield Payload(b"", kind)
    yield Payload(b"\0\1\0\0\xff\0\0\0ab", kind)
    yield Payload(ros.message("std_msgs/String", data="a").data + b"\0" * 8, kind)
    yield Payload(b"\1\0\0\0a", STRING)


async def test_what_would_stop_a_robots_process_is_not_published(here: zenoh.Session, domain: int) -> None:
    ros = RosTypes("jazzy")
    async with Robot(here, ros, domain=domain) as ours:
        ours.advertise("/chatter", "std_msgs/String")
        for payload in unfit(ros):
            with pytest.raises(InvalidPayload):
                ours.publish("/chatter", payload)
        with pytest.raises(UnknownRosType):
            ours.publish("/wheels", "my_robot/Wheels", {})
        with raises_with(RosError, code="ros-type-mismatch"):
            ours.publish("/chatter", "std_msgs/Bool", {"data": True})


async def test_publishers_and_tokens_are_bounded(
    here: zenoh.Session, there: zenoh.Session, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bridges.ros2._robot.ROBOT_LIMITS", ROBOT_LIMITS._replace(endpoints=2))
    monkeypatch.setattr("bridges.ros2._node.GRAPH_LIMITS", GRAPH_LIMITS._replace(per_session=3))
    drops = Drops()
    async with Robot(here, RosTypes("jazzy"), domain=domain, drops=drops) as ours:
        for name in ("/a", "/b"):
            ours.advertise(name, "std_msgs/String", qos=SENSOR_DATA)
        with raises_with(InputError, code="too-many-ros-endpoints"):
            ours.advertise("/c", "std_msgs/String")
        tokens = [
            there.liveliness().declare_token(f"{PREFIX}/{domain}/ab/0/{number}/NN/%/%/node{number}")
            for number in range(5)
        ]
        tokens.append(there.liveliness().declare_token(f"{PREFIX}/{domain}/nonsense"))
        await until(lambda: drops.totals() == {"token": 2, "bad-token": 1}, what="refused tokens")

        assert len([entity for entity in ours.graph.entities() if entity.session == "ab"]) == 3
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
        await until(lambda: ours.graph.nodes() == ["/aira"])


async def test_a_payload_is_published_as_ros_2_writes_it(here: zenoh.Session, domain: int) -> None:
    ros = RosTypes("jazzy")
    async with Robot(here, ros, domain=domain) as ours:
        publisher = ours.advertise("/flag", "std_msgs/Bool")
        kind = ros.payload_type("std_msgs/Bool")
        written = [
            publisher.put(Payload(data, kind)).data for data in (b"\0\1\0\0\7", b"\0\0\0\0\1", b"\0\1\0\0\0\0\0\0")
        ]

    assert written == [b"\0\1\0\0\1", b"\0\1\0\0\1", b"\0\1\0\0\0"]


def test_types_of_ros_1_are_refused(here: zenoh.Session) -> None:
    with pytest.raises(UnknownRosType):
        Robot(here, RosTypes("noetic"))


async def test_a_router_that_returns_brings_everything_back(
    router: EmbeddedRouter, here: zenoh.Session, there: zenoh.Session, domain: int
) -> None:
    async with (
        Robot(here, RosTypes("jazzy"), domain=domain) as ours,
        Robot(there, RosTypes("jazzy"), domain=domain, node="talker") as talker,
    ):
        publisher = talker.advertise("/chatter", "std_msgs/String")
        async with ours.subscribe("/chatter") as messages:
            await talker.ready("/chatter")
            await asyncio.to_thread(router.stop)
            try:
                await until(lambda: "/talker" not in ours.graph.nodes())
            finally:
                await asyncio.to_thread(router.start)
            await ours.ready("/chatter", timeout=20)
            await until(lambda: publisher.is_heard)
            publisher.put({"data": "again"})
            (message,) = await heard(messages, 1)

    assert text(message) == "again"

"""What a viewer gets to see of messages of all kinds."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import msgspec

from bridges.foxglove.server import NEW_CHANNELS, SHOWN_LIMITS
from mesh.recording import foxglove
from mesh.recording.ros import RosTypes
from schemas.payloads import JSON, RAW, Payload, PayloadType, encode_value
from tests.support.foxglove.viewer import viewing
from tests.support.waiting import until

if TYPE_CHECKING:
    from bridges.foxglove.server import FoxgloveServer

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(100))


def without_schema(payload: Payload) -> tuple[bytes, PayloadType]:
    """A message as it travels on the mesh: with the name of its type only."""
    return payload.data, PayloadType(payload.type.encoding, payload.type.schema_name, payload.type.schema_encoding)


def show(server: FoxgloveServer) -> None:
    """One message of each kind."""
    noetic, jazzy = RosTypes("noetic"), RosTypes("jazzy")
    for topic, value in (("/text", "on"), ("/number", 1.5), ("/list", [1.5, 2.5]), ("/empty", None), ("/raw", b"abc")):
        server.publish(topic, *encode_value(value))
    server.publish("/json", b'{"a": 1, "b": {"c": [2]}}', JSON)
    server.publish("/json_list", b"[1, 2]", JSON)
    server.publish("/ros1", *without_schema(noetic.message("geometry_msgs/Twist", linear={"x": 2.0})))
    server.publish("/ros2", *without_schema(jazzy.message("geometry_msgs/TwistStamped", header={"frame_id": "map"})))
    server.publish("/unknown", b"123", PayloadType("ros1", "my_msgs/Own", "ros1msg"))
    server.publish("/image", PNG, RAW)
    server.publish_value("/fix", foxglove.LocationFix(latitude=52.5, longitude=13.4))


async def test_messages_of_all_kinds_are_decoded(serve: Any) -> None:
    async with serve() as server:
        show(server)
        async with viewing(server.front.url) as viewer:
            # What was shown before the viewer came is repeated to it.
            await until(lambda: len({seen.topic for seen in viewer.seen}) == 12)
            values = {seen.topic: seen.value for seen in viewer.seen}
            assert (values["/text"].data, values["/number"].data) == ("on", 1.5)
            assert list(values["/list"].data) == [1.5, 2.5]
            assert values["/json"] == {"a": 1, "b": {"c": [2]}}
            assert values["/json_list"] == {"value": [1, 2]}
            assert values["/ros1"].linear.x == 2.0
            assert values["/ros2"].header.frame_id == "map"
            assert values["/unknown"]["size"] == 3
            assert base64.b64decode(values["/raw"]["data"]) == b"abc"
            assert base64.b64decode(values["/image"]["data"]) == PNG
            assert viewer.topics["/image"]["schemaName"] == "foxglove.CompressedImage"
            assert viewer.topics["/fix"]["schemaName"] == "foxglove.LocationFix"
            assert viewer.topics["/ros2"]["schemaName"] == "geometry_msgs/msg/TwistStamped"
            assert values["/fix"]["latitude"] == 52.5
            assert viewer.statuses == []


async def test_an_own_type_is_shown_by_the_definition_of_the_job(serve: Any) -> None:
    own = PayloadType("ros1", "my_msgs/Own", "ros1msg", b"uint8 a\nuint8 b\n")
    async with serve(known=(own,)) as server, viewing(server.front.url) as viewer:
        server.publish("/own", b"\x01\x02", PayloadType("ros1", "my_msgs/Own", "ros1msg"))
        (value,) = await viewer.until_seen("/own")
        assert (value.a, value.b) == (1, 2)


async def test_an_own_type_is_shown_by_the_definition_that_came_with_the_first_message(serve: Any) -> None:
    own = PayloadType("cdr", "my_msgs/msg/Own", "ros2msg")
    payload = b"\x00\x01\x00\x00\x01\x02"
    async with serve() as server, viewing(server.front.url) as viewer:
        server.publish("/first", payload, msgspec.structs.replace(own, schema_data=b"uint8 a\nuint8 b\n"))
        server.publish("/second", payload, own)
        (value,) = await viewer.until_seen("/second")
        assert (value.a, value.b) == (1, 2)


async def test_a_schema_that_widens_reaches_the_viewer(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        server.publish("/x", b'{"a": 1}', JSON)
        await viewer.until_seen("/x")
        server.publish("/x", b'{"a": 1, "b": 2}', JSON)
        await viewer.until_seen("/x", 2)
        assert '"b"' in viewer.topics["/x"]["schema"]
        assert len(viewer.channels) == 1
        assert viewer.values("/x") == [{"a": 1}, {"a": 1, "b": 2}]


async def test_the_last_messages_are_repeated_though_their_schema_widens(serve: Any) -> None:
    async with serve() as server:
        wanted = [{"a": 1}, {"b": 2}, {"c": 3}]
        for value in wanted:
            server.publish_value("/x", value)
        async with viewing(server.front.url) as viewer:
            assert await viewer.until_seen("/x", 3) == wanted
            assert '"c"' in viewer.topics["/x"]["schema"]


async def test_two_types_on_a_topic_are_two_topics(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        for number in range(100):
            server.publish("/x", *encode_value("on"))
            server.publish("/x", *encode_value(float(number)))
        await until(lambda: len(viewer.channels) == 2)
        await until(lambda: viewer.values("/x (std_msgs/Float64)"))
        assert viewer.topics["/x"]["schemaName"] == "std_msgs/String"


async def test_the_time_of_a_message_is_kept(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url) as viewer:
        server.publish("/x", *encode_value("on"), at_ns=123)
        await viewer.until_seen("/x")
        assert viewer.seen[0].log_time == 123


async def test_topics_are_bounded_and_those_of_one_sender(serve: Any) -> None:
    async with serve() as server, viewing(server.front.url, "/none") as viewer:
        for number in range(3 * SHOWN_LIMITS.channels):
            server.publish(f"/flood/{number}", *encode_value("on"), sender="a flood")
        server.publish("/honest", *encode_value("on"), sender="honest")
        await until(lambda: "/honest" in viewer.topics)
        assert len(viewer.channels) <= NEW_CHANNELS.burst + 20
        assert server.front.drops.senders()["foxglove-topics"]["a flood"] > SHOWN_LIMITS.channels
        for sender in range(20):
            for number in range(100):
                server.publish(f"/{sender}/{number}", *encode_value("on"), sender=str(sender))
        server.publish("/last", *encode_value("on"), sender="another")
        assert len(server._channels) <= SHOWN_LIMITS.channels


async def test_a_hostile_schema_hurts_no_other_topic(serve: Any) -> None:
    strange = (b"\xff\xfe", b"\x00", "\udcff".encode(errors="surrogatepass"))
    async with serve() as server:
        for number, data in enumerate(strange):
            for encoding in ("ros1", "cdr", "json", "protobuf"):
                for schema in ("ros1msg", "jsonschema", "protobuf", ""):
                    kind = PayloadType(encoding, f"hostile/{number}{encoding}{schema}", schema, data)
                    server.publish(f"/hostile/{number}/{encoding}/{schema}", b"1", kind)
        server.publish("/honest", *encode_value("on"))
        async with viewing(server.front.url, "/honest") as viewer:
            assert (await viewer.until_seen("/honest"))[0].data == "on"


async def test_what_is_too_large_is_dropped(serve: Any) -> None:
    async with serve() as server:
        server.publish("/x", bytes(SHOWN_LIMITS.message + 1), RAW)
        assert server.front.drops.totals() == {"foxglove-too-large": 1}

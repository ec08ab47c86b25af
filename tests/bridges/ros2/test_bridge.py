"""The bridge between the mesh and a ROS 2 system, each on a router of its own."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

import pytest
import pytest_asyncio
import zenoh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from bridges.devices import said_by
from bridges.ros2 import Robot, RosAllowed
from bridges.ros2._bridge import RosBridge, check_apart
from mesh import RosTypes
from mesh.base.background import Background
from mesh.errors import ConfigurationError, InputError
from mesh.network import Endpoints, Network
from mesh.recording import Played, open_objective, pack
from schemas import payloads
from schemas.keys import topic_selector
from schemas.payloads import defined_by
from schemas.status import ALIVE
from tests.support.commands import AIRA, Serving, aira, refused
from tests.support.market import offering
from tests.support.raising import raises_with
from tests.support.routers import EmbeddedRouter
from tests.support.waiting import until, until_answered, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.handlers import Job
    from tests.support.market import Place


AGENT: Final = "0x" + "11" * 20
JOB: Final = "0x" + "22" * 20
OWN: Final = "float32 level\nstring place\n"
ALLOW: Final = RosAllowed(publish=("/cmd_vel", "/said"), subscribe=("/odom", "/own/*"))


@pytest_asyncio.fixture
async def mesh(router: EmbeddedRouter) -> AsyncIterator[zenoh.Session]:
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        yield network.session


@pytest_asyncio.fixture
async def field() -> AsyncIterator[EmbeddedRouter]:
    """The router of the ROS 2 system."""
    with EmbeddedRouter() as running:
        yield running


@asynccontextmanager
async def session_on(router: EmbeddedRouter) -> AsyncIterator[zenoh.Session]:
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        yield network.session


def types() -> RosTypes:
    known = RosTypes("jazzy")
    known.register("own_msgs/Level", OWN)
    return known


@asynccontextmanager
async def bridged(mesh: zenoh.Session, field: EmbeddedRouter, agent: str = AGENT, **options: Any) -> AsyncIterator[Any]:
    """A bridge at work, and the robot at its other side."""
    async with (
        session_on(field) as ros,
        session_on(field) as there,
        Robot(there, types(), node="rover") as rover,
        RosBridge(mesh, ros, types(), options.get("allow", ALLOW), agent=agent) as bridge,
        Background() as tasks,
    ):
        tasks.start(bridge.run(), "bridge of the test")
        yield bridge, rover


class Heard:
    """What is put on the mesh, except by this class."""

    def __init__(self, session: zenoh.Session) -> None:
        self.samples: list[Any] = []
        self._subscriber = session.declare_subscriber("**", self.samples.append)

    def on(self, key: str) -> list[Any]:
        return [sample for sample in self.samples if str(sample.key_expr) == key]


def twist(x: float) -> payloads.Payload:
    return types().message("geometry_msgs/Twist", linear={"x": x})


async def test_the_robots_topics_are_those_of_a_device(mesh: zenoh.Session, field: EmbeddedRouter) -> None:
    heard = Heard(mesh)
    key = f"aira/agent/{AGENT}/device/robot/own/level"
    async with bridged(mesh, field) as (_, rover):
        sent = rover.types.message("own_msgs/Level", level=0.5, place="tank")
        publisher = rover.advertise("/own/level", "own_msgs/Level")
        await until(lambda: publisher.is_heard, what="the bridge")
        publisher.put(sent)
        await until(lambda: heard.on(key), what="the message")

        [sample] = heard.on(key)
        kind = payloads.payload_type(str(sample.encoding))
        attached = sample.attachment.to_bytes()
        assert sample.payload.to_bytes() == sent.data
        assert attached.startswith(said_by("robot") + b"\n")
        assert defined_by(attached, kind) == sent.type
        assert mesh.liveliness().get(f"aira/agent/{AGENT}/device/robot/present").recv().ok is not None


async def test_in_a_job_they_are_those_of_the_job(mesh: zenoh.Session, field: EmbeddedRouter) -> None:
    heard = Heard(mesh)
    async with bridged(mesh, field) as (bridge, rover):
        publisher = rover.advertise("/odom", "geometry_msgs/Twist")
        await until(lambda: publisher.is_heard, what="the bridge")
        mesh.put(f"aira/agent/{AGENT}/liability/{JOB}/ready", b"{}")
        await until(lambda: bridge.jobs.current == JOB, what="the job")
        publisher.put(twist(1))
        await until(lambda: heard.on(f"aira/agent/{AGENT}/liability/{JOB}/topic/odom"), what="the message")
        assert not heard.on(f"aira/agent/{AGENT}/device/robot/odom")


async def test_the_presence_of_the_robot_is_known_and_recorded(mesh: zenoh.Session, field: EmbeddedRouter) -> None:
    heard = Heard(mesh)
    async with (
        session_on(field) as ros,
        session_on(field) as there,
        RosBridge(mesh, ros, types(), ALLOW, agent=AGENT) as bridge,
        Background() as tasks,
    ):
        tasks.start(bridge.run(), "bridge of the test")
        mesh.put(f"aira/agent/{AGENT}/liability/{JOB}/ready", b"{}")
        await until(lambda: bridge.jobs.current == JOB, what="the job")
        assert bridge.parts()["robot"] != ALIVE
        async with Robot(there, types(), node="rover"):
            await until(lambda: bridge.parts()["robot"] == ALIVE, what="the robot")
        await until(lambda: bridge.parts()["robot"] != ALIVE, what="its end")
    said = heard.on(f"aira/agent/{AGENT}/liability/{JOB}/topic/aira/device/robot")
    decoded: list[Any] = [types().decode("std_msgs/String", sample.payload.to_bytes()) for sample in said]
    assert [message.data for message in decoded] == ["present", "absent"]


@pytest.mark.parametrize(
    "key", ["device/robot/cmd_vel", f"liability/{JOB}/topic/cmd_vel", f"liability/{JOB}/objective/cmd_vel"]
)
@pytest.mark.parametrize("encoding", ["application/cdr;geometry_msgs/msg/Twist", "application/json"])
async def test_what_the_mesh_says_is_published_to_the_robot(
    mesh: zenoh.Session, field: EmbeddedRouter, key: str, encoding: str
) -> None:
    payload = twist(0.25).data if "cdr" in encoding else b'{"linear":{"x":0.25}}'
    async with bridged(mesh, field) as (bridge, rover), rover.subscribe("/cmd_vel", "geometry_msgs/Twist") as messages:
        first = asyncio.create_task(anext(messages))
        while not first.done():  # declarations take their time to get around
            mesh.put(f"aira/agent/{AGENT}/{key}", payload, encoding=encoding)
            await asyncio.wait([first], timeout=0.1)
        assert (await first).payload == twist(0.25)
        assert bridge.published >= 1


async def test_a_query_is_answered_when_all_commands_before_it_are_published(
    mesh: zenoh.Session, field: EmbeddedRouter
) -> None:
    keys = ["device/robot/cmd_vel", f"liability/{JOB}/topic/cmd_vel", f"liability/{JOB}/objective/cmd_vel"]
    idle = f"aira/agent/{AGENT}/device/robot/aira/idle"
    async with bridged(mesh, field) as (bridge, _):
        for key in keys:
            await until_heard(mesh, f"aira/agent/{AGENT}/{key}")
        await until_answered(mesh, idle)
        command, encoding, block = twist(1).data, twist(1).type.zenoh_encoding, zenoh.CongestionControl.BLOCK
        for times in range(1, 4):
            for key in 200 * keys:
                mesh.put(f"aira/agent/{AGENT}/{key}", command, encoding=encoding, congestion_control=block)
            replies = await asyncio.to_thread(lambda: list(mesh.get(idle, timeout=60)))
            assert [reply.ok is not None for reply in replies] == [True]
            assert bridge.published == times * 200 * len(keys)


async def test_nothing_is_carried_that_is_not_allowed(mesh: zenoh.Session, field: EmbeddedRouter) -> None:
    heard = Heard(mesh)
    async with bridged(mesh, field) as (bridge, rover), session_on(field) as there:
        leaked = Heard(there)
        allowed = rover.advertise("/odom", "geometry_msgs/Twist")
        secret = rover.advertise("/secret", "geometry_msgs/Twist")
        back = rover.advertise("/cmd_vel", "geometry_msgs/Twist")
        while not heard.on(f"aira/agent/{AGENT}/device/robot/odom"):  # until the bridge has found it
            for publisher in (secret, back, allowed):
                publisher.put(twist(1))
            await asyncio.sleep(0.05)
        for topic in ("other", "odom"):
            mesh.put(f"aira/agent/{AGENT}/device/robot/{topic}", twist(2).data, encoding="application/cdr")
        mesh.put(f"aira/agent/{AGENT}/device/robot/cmd_vel", twist(3).data, encoding=twist(3).type.zenoh_encoding)
        await until(lambda: bridge.published, what="a command")

        assert bridge.published == 1
        of_ros = {str(sample.key_expr).split("/")[1] for sample in leaked.samples}
        assert of_ros <= {"odom", "secret", "cmd_vel"}
        assert all(str(sample.key_expr).startswith("aira/") for sample in heard.samples)
        assert not any("secret" in str(sample.key_expr) for sample in heard.samples)


@pytest.mark.parametrize("payload", [b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(5), b"x" * 100])
async def test_a_malformed_command_is_counted_and_never_reaches_the_robot(
    mesh: zenoh.Session, field: EmbeddedRouter, payload: bytes
) -> None:
    key = f"aira/agent/{AGENT}/device/robot/cmd_vel"
    async with bridged(mesh, field) as (bridge, rover), rover.subscribe("/cmd_vel", "geometry_msgs/Twist") as messages:
        first = asyncio.create_task(anext(messages))
        while not first.done():
            mesh.put(key, payload, encoding=twist(0).type.zenoh_encoding)
            mesh.put(key, twist(4).data, encoding=twist(0).type.zenoh_encoding)
            await asyncio.wait([first], timeout=0.1)
        assert (await first).payload == twist(4)
        assert bridge.drops.totals()["ros-command"] >= 1


async def test_two_sessions_on_one_router_are_refused(mesh: zenoh.Session, router: EmbeddedRouter) -> None:
    async with session_on(router) as other:
        with raises_with(ConfigurationError, code="ros-router-shared"):
            check_apart(mesh, other)


def test_the_command_needs_something_allowed_and_another_router() -> None:
    words = ("bridge", "ros2", "--agent", AGENT, "--connect", "tcp/127.0.0.1:1", "--ros2-connect")
    refused(aira(*words, "tcp/127.0.0.1:2"), InputError, "no topic", code="ros-nothing-allowed")
    refused(
        aira(*words, "tcp/127.0.0.1:1", "--publish", "/cmd_vel"),
        ConfigurationError,
        "127.0.0.1:1",
        code="ros-router-shared",
    )


async def test_a_paid_job_drives_the_robot_and_others_open_its_recording(
    place: Place, field: EmbeddedRouter, tmp_path: Path
) -> None:
    robot = offering(place.agent("robot"))
    driven: list[float] = []
    answered: list[Any] = []
    levels: list[Any] = []

    @robot.on("/cmd_vel")
    async def wait(job: Job, message: object) -> None:
        await until(lambda: min(len(answered), len(levels)) > job.position, what="the robot's answers", seconds=60)

    pack([Played("/cmd_vel", twist(n / 4).data, n, n, 0, twist(0).type) for n in range(3)], tmp_path / "drive.mcap")
    places = ("--agent", place.address("robot"), "--connect", place.endpoint, "--ros2-connect", field.endpoint)
    allowed = ("--publish", "/cmd_vel", "--subscribe", "/odom", "--subscribe", "/own/*")
    definition = tmp_path / "own_msgs" / "msg" / "Level.msg"
    definition.parent.mkdir(parents=True)
    definition.write_text(OWN)
    with Serving(*AIRA, "bridge", "ros2", *places, *allowed, "--types", tmp_path, says="bridge of 0x"):
        async with session_on(field) as there, Robot(there, types(), node="rover") as rover, Background() as tasks:

            async def drive() -> None:
                async with rover.subscribe("/cmd_vel", "geometry_msgs/Twist") as messages:
                    async for message in messages:
                        moved = rover.types.decode("geometry_msgs/Twist", message.payload.data)
                        driven.append(moved.linear.x)
                        tank.put({"level": moved.linear.x, "place": "tank"})
                        odometer.put(message.payload)

            tank = rover.advertise("/own/level", "own_msgs/Level")
            odometer = rover.advertise("/odom", "geometry_msgs/Twist")
            tasks.start(drive(), "rover")
            await until(lambda: odometer.is_heard and tank.is_heard, what="the bridge")
            async with place.at_work(robot) as person:
                for topic, heard in (("/odom", answered), ("/own/level", levels)):
                    selector = topic_selector(place.address("robot"), topic=topic)
                    robot.parts.network.session.declare_subscriber(selector, heard.append)
                contract = await person.demand(tmp_path / "drive.mcap", cost=1)
                assert (await contract.outcome()).success
                recording = (await contract.recording()).rename(tmp_path / "result.mcap")

    assert driven == [0.0, 0.25, 0.5]
    ours = [(one.topic, one.payload) for one in open_objective(recording).messages()]
    assert [topic for topic, _ in ours].count("/own/level") == 3
    with AnyReader([recording]) as reader:
        assert [(each.topic, raw) for each, _, raw in reader.messages()] == ours
        values: list[Any] = [reader.deserialize(raw, each.msgtype) for each, _, raw in reader.messages()]
    with recording.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        decoded = [one.decoded_message for one in found]
    for theirs, others in zip(values, decoded, strict=True):
        if hasattr(theirs, "level"):
            assert (theirs.level, theirs.place) == (others.level, others.place)
        else:
            assert theirs.linear.x == others.linear.x

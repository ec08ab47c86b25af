"""`aira edge` as a process of its own, between a simulated board and the mesh."""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
import zenoh

from bridges.serial._device import Device
from bridges.serial._edge import Edge, EdgeOptions
from bridges.serial.dialect import BoardTopic, CallFailed, CallStatus, Flow, MessageReceived
from schemas import String
from schemas.keys import any_topic_selector
from schemas.payloads import STRING
from tests.support.boards import COUNTER, ROSSERIAL_ECHO, ROSSERIAL_TWINS, board, edge
from tests.support.commands import aira
from tests.support.orders import ROBOT
from tests.support.ports import free_port
from tests.support.raising import raises_with
from tests.support.routers import client_config
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter


LONG = 60.0
MEGABYTES = 40
"""The most resident memory of an edge agent."""


def resident(pid: int) -> float:
    """The resident memory of a process, in megabytes."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found
    return int(found[1]) / 1024


async def test_a_call_over_the_mesh_returns_the_boards_answer(place: Place) -> None:
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint) as process:
        async with place.agent("robot") as robot:
            device = Device(robot)
            reply = await device.call("/add", 5)
            assert (reply.value, reply.status) == (5, CallStatus.DONE)
            with raises_with(CallFailed, code="call-refused") as by_board:
                await device.call("/add", "five")
            assert by_board.value.reason == "refused"
            with raises_with(CallFailed, code="call-refused") as by_edge:
                await device.call("/add", {"a": "x" * 100})
            assert by_edge.value.reason == "unfit"
            assert resident(process.pid) < MEGABYTES


async def test_messages_of_a_board_arrive_under_its_agent(place: Place) -> None:
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint, "--name", "uno"):
        async with place.agent("robot") as robot:
            device = Device(robot, "uno")
            async with device.listen("/added") as messages:
                await device.call("/add", 5)
                async with asyncio.timeout(LONG):
                    assert await anext(messages) == 5


async def test_the_edge_agent_reports_which_device_it_serves(place: Place) -> None:
    address = place.address("robot")
    with board(COUNTER) as uno, edge(uno.port, address, place.endpoint):
        async with place.agent("robot") as robot:
            await until_found(Device(robot).is_present, what="the board", seconds=LONG)
            session = robot.parts.network.session
            [reply] = session.get(f"aira/agent/{address.lower()}/device/board/about")
            assert reply.ok is not None
            facts: dict[str, Any] = msgspec.json.decode(reply.ok.payload.to_bytes())
    assert (facts["name"], facts["version"], facts["present"]) == ("counter", "1.0", True)
    assert {"name": "/add", "flow": "hears", "type": "json"} in facts["topics"]


async def test_publishers_and_subscribers_of_one_topic_share_it(place: Place) -> None:
    address = place.address("robot")
    options = ("--protocol", "rosserial", "--baud", "57600")
    with board(ROSSERIAL_TWINS) as uno, edge(uno.port, address, place.endpoint, *options) as process:
        async with place.agent("robot") as robot:
            device = Device(robot)
            await until_found(device.is_present, what="the board", seconds=LONG)
            async with device.listen("/said") as messages, asyncio.timeout(LONG):
                await device.call("/hear", String("go"))
                said = [await anext(messages), await anext(messages)]
        process.wait_until_said("/said of the board is not used: it has two types, std_msgs/String and std_msgs/Empty")
    assert said == ["first", "second"]


async def test_a_call_to_an_absent_device_was_not_done(place: Place) -> None:
    async with place.agent("robot") as robot:
        with raises_with(CallFailed, code="call-not-done") as caught:
            await Device(robot, patience=0.5).call("/add", 5)
        assert (caught.value.code, caught.value.reason) == ("call-not-done", "absent")


async def test_presence_follows_the_cable(place: Place) -> None:
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint):
        async with place.agent("robot") as robot:
            device = Device(robot)
            await until_found(device.is_present, what="the board", seconds=LONG)
            uno.unplug()

            async def is_absent() -> bool:
                return not await device.is_present()

            await until_found(is_absent, what="its absence", seconds=LONG)
            uno.plug()
            assert (await device.call("/add", 1)).value == 1


async def test_two_boards_of_two_agents_do_not_affect_each_other(place: Place) -> None:
    with (
        board(COUNTER) as first,
        board(ROSSERIAL_ECHO) as second,
        edge(first.port, place.address("robot"), place.endpoint),
        edge(second.port, place.address("person"), place.endpoint, "--protocol", "rosserial"),
    ):
        async with place.agent("robot") as robot, place.agent("person") as person:
            assert (await Device(robot).call("/add", 5)).value == 5
            reply = await Device(person).call("/hear", String("hello"))
            assert (reply.value, reply.status) == (None, CallStatus.READ)
            assert (await Device(person).call("/twice", b"")).status is CallStatus.DONE
            with pytest.raises(CallFailed):
                await Device(robot, patience=LONG).call("/hear", String("hello"))


def loaded_by(dialects: str, *suspects: str) -> list[str]:
    """Those of these modules that an edge agent has loaded for its dialects (a list in Python)."""
    code = (
        "import sys, mesh.__main__, mesh.cli, bridges.serial.cli, bridges.serial._edge;"
        "from bridges.serial.dialect import dialect_names, load_dialect;"
        f"[load_dialect(name) for name in {dialects}];"
        f"print(*sorted({set(suspects)} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_an_edge_agent_imports_no_chain_and_no_event_loop() -> None:
    assert loaded_by("dialect_names()", "web3", "eth_account", "eth_abi", "asyncio", "aiohttp", "mcap") == []


def test_an_edge_agent_loads_neither_openssl_nor_unicodes_tables() -> None:
    """They would be an eighth of its memory."""
    assert loaded_by("['frames', 'rosserial']", "_hashlib", "unicodedata") == []


@pytest.mark.parametrize(
    ("sketch", "protocol", "named"),
    [(COUNTER, "frames", "the board counter 1.0 is present"), (ROSSERIAL_ECHO, "rosserial", "the board is present")],
)
async def test_the_log_names_the_board_if_it_has_a_name(place: Place, sketch: str, protocol: str, named: str) -> None:
    options = ("--protocol", protocol)
    with board(sketch) as uno, edge(uno.port, place.address("robot"), place.endpoint, *options) as process:
        await until(lambda: "is present: " in process.log(), what="the board", seconds=LONG)
        assert f"{named}: /" in process.log()


async def test_a_board_that_never_answers_is_logged_once(place: Place) -> None:
    options = ("--protocol", "rosserial")
    with board(COUNTER) as uno, edge(uno.port, place.address("robot"), place.endpoint, *options) as process:
        await until(lambda: "no board answers on" in process.log(), what="the warning", seconds=LONG)
        assert process.log().count("no board answers on") == 1


def test_an_edge_agent_without_a_router_is_one_clear_line() -> None:
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    done = aira("edge", "/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--connect", nowhere, "--connect-timeout", "0.2")
    assert done.returncode == 1
    line, _hint = done.stderr.splitlines()
    assert nowhere in line
    assert line.endswith("[network-unavailable]")


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_also_without_a_board(router: EmbeddedRouter, how: signal.Signals, tmp_path: Path) -> None:
    with edge(tmp_path / "tty", "0x" + "11" * 20, router.endpoint) as process:
        code, _ = process.end(how)
        assert code == 0


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("ttyACM0", "--agent", "0x" + "11" * 20), "[input-error]"),
        (("/dev/ttyACM0", "--agent", "robot"), "[invalid-key]"),
        (("/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--name", "a/b"), "[invalid-key]"),
        (("/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--baud", "9"), "--baud"),
        (("/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--protocol", "morse"), "'frames', 'rosserial'"),
        (("/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--map", "led=/lamp"), "TOPIC=/NAME"),
        (("/dev/ttyACM0", "--agent", "0x" + "11" * 20, "--map", "/a=/b", "--map", "/a=/c"), "[input-error]"),
    ],
)
def test_an_invalid_option_is_one_clear_line(arguments: tuple[str, ...], reported: str) -> None:
    done = aira("edge", *arguments, "--connect", "tcp/127.0.0.1:1", "--connect-timeout", "0.1")
    assert done.returncode == 2
    assert reported in done.stderr
    assert "Traceback" not in done.stderr


async def test_a_topic_that_no_board_has_announced_is_published_if_its_name_is_valid(
    router: EmbeddedRouter, caplog: pytest.LogCaptureFixture
) -> None:
    edge = Edge(EdgeOptions(agent=ROBOT.address, port="/dev/ttyNONE", protocol="frames", baud=57_600))
    heard: list[zenoh.Sample] = []
    with zenoh.open(client_config(router.endpoint)) as session:
        edge.stop()
        edge.run(session)  # ends at once
        session.declare_subscriber(any_topic_selector(ROBOT.address, "/late"), heard.append)
        for name in ("/no name", "/no name", "/late"):
            edge._on_event(MessageReceived(BoardTopic(name, Flow.PUBLISHES, STRING, 7), String("x").encode()))
        await until(lambda: heard, what="the message", seconds=LONG)
    assert heard[0].payload.to_bytes() == String("x").encode()
    assert [record.event for record in caplog.records] == ["topic-rejected"]  # type: ignore[attr-defined]

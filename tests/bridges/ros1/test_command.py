"""`aira bridge ros1` as people start it, beside their nodes."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import pytest

from bridges.ros1.cli import OURS, PARAMETERS, PRIVATE, settings_with_parameters
from bridges.ros1.master import RosMaster
from bridges.ros1.node import Ros1Graph, call_api
from mesh.base.flood import Drops
from mesh.settings import Settings
from tests.support.commands import AIRA, Serving, aira, invoke
from tests.support.objectives import objective
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from tests.support.ros1.peers import Ros, RosMasterServer

MODEL = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
RECORDING = "/liability/executor/recording_topics"


async def test_a_job_survives_the_death_of_the_bridge(
    tmp_path: Path, rosmaster: RosMasterServer, ros: Callable[[str], Ros], messages: dict[str, Path]
) -> None:
    """The command alone is the robot: its account, its agent, and the legacy stack's names. The node finds it again."""
    (tmp_path / "objective.mcap").write_bytes(objective(("/blink", None)))
    endpoint, port, data = f"tcp/127.0.0.1:{free_port()}", str(free_port()), tmp_path / "data"
    keys = data / "development"
    shared = {
        "AIRA_CONNECT": endpoint,
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{port}",
        "AIRA_DATA_DIR": str(data),
        "AIRA_KEYFILE_PASSWORD_FILE": str(keys / "password"),
    }
    robot = shared | {"AIRA_KEYFILE": str(keys / "robot.json"), "AIRA_OPEN_SERVICES": "true"}
    person = shared | {"AIRA_KEYFILE": str(keys / "person.json")}
    up = ("up", "--port", port, "--listen", endpoint, "--data-dir", str(data), "--engine", "embedded")
    words = ("bridge", "ros1", "--ros-master-uri", rosmaster.uri)
    demand = ("demand", "--model", MODEL, "--objective", tmp_path / "objective.mcap", "--cost", "1", "--json")
    market = Serving(*AIRA, *up, says="provider    0x")
    bridge = Serving(*AIRA, *words, says="the ROS master is", variables=robot)
    with market, bridge:
        async with ros(rosmaster.uri).node("blink", "Empty", "told", messages=messages["3"]) as node:
            assert await node.hear() == "ready"
            demanding = asyncio.create_task(asyncio.to_thread(aira, *demand, **person))
            assert await node.hear() == {"started": True}
            assert await node.hear() == {"blink": "on"}
            await asyncio.sleep(1.5)  # what was recorded a second ago is on the disk
            bridge.kill()
            await asyncio.to_thread(bridge.start)
            node.tell("go on")
            assert await node.hear() == "finished"
            done = await demanding
        assert done.returncode == 0, (done.stderr, bridge.log())


async def test_parameters_are_settings_and_settings_are_parameters(
    graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]], caplog: pytest.LogCaptureFixture
) -> None:
    """What a user has set counts; what an earlier bridge has set does not; what means nothing here is named."""
    caplog.set_level(logging.INFO)
    async with graph() as here:
        await call_api(here.master, "setParam", "/user", "/liability/executor/master_check_interval", 0.1)
        await call_api(here.master, "setParam", "/user", RECORDING, "/odom, /scan")
        settings = await settings_with_parameters(here, Settings(lighthouse_contract="one.lighthouse.3.robonomics.eth"))
        assert settings.recording_topics == "/odom, /scan"
        shown = await here.call("getParam", "/liability/infochan/ipfs_channel/lighthouse_contract")
        assert shown == "one.lighthouse.3.robonomics.eth"
        again = await settings_with_parameters(here, Settings(lighthouse_contract="two.lighthouse.3.robonomics.eth"))
        assert again.lighthouse_contract == "two.lighthouse.3.robonomics.eth"
        assert again.recording_topics == "/odom, /scan"
        assert "not read: /liability/executor/master_check_interval" in caplog.text
        shown = {name for name, _ in await here.call("getParam", OURS)}
        assert shown == {name for name, option in PARAMETERS.items() if option not in PRIVATE} - {RECORDING}


async def test_paths_and_urls_of_nodes_are_not_written_to_the_parameter_server(
    graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]],
) -> None:
    """Whoever reaches the master could read them."""
    private = {"keyfile": "/secret/key", "keyfile_password_file": "/secret/word"}
    private |= {"web3_http_provider": "http://127.0.0.1/secret", "web3_ws_provider": "ws://127.0.0.1/secret"}
    async with graph() as here:
        assert await settings_with_parameters(here, Settings(**private)) == Settings(**private)  # type: ignore[arg-type]
        assert "secret" not in str(await here.call("getParam", "/"))
        await call_api(here.master, "setParam", "/user", "/liability/executor/keyfile", "/another/key")
        assert (await settings_with_parameters(here, Settings())).keyfile == "/another/key"


def test_messages_are_written_for_catkin_and_python(tmp_path: Path) -> None:
    """`--messages` needs neither a router nor a master."""
    done = invoke("bridge", "ros1", "--messages", tmp_path / "messages", "--message-version", "5")
    assert done.returncode == 0, done.stderr
    manifest = (tmp_path / "messages" / "src" / "robonomics_liability" / "package.xml").read_text()
    assert "<depend>ipfs_common</depend>" in manifest


WRONG = {
    "no agent": ((), "input-error"),
    "no address": (("--agent", "0x1"), "invalid-address"),
    "no address to listen on": (("--ros-ip", "robot"), "input-error"),
    "no address of a master": (("--ros-master-uri", "127.0.0.1:11311"), "input-error"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_command_that_can_not_work_says_why(name: str) -> None:
    """In one line, and one with what to do."""
    words, code = WRONG[name]
    master = f"http://127.0.0.1:{free_port()}/"
    done = invoke("bridge", "ros1", "--master", "--ros-master-uri", master, *words)
    assert done.returncode == 2
    assert f"[{code}]" in done.stderr
    assert done.stderr.count("\n") <= 2, done.stderr


async def test_a_second_master_on_a_port_is_refused_with_what_to_do(
    graph: Callable[[], AbstractAsyncContextManager[Ros1Graph]],
) -> None:
    """A ROS master that runs already is the one to join."""
    async with graph() as here:
        done = await asyncio.to_thread(aira, "bridge", "ros1", "--master", "--ros-master-uri", here.master)
        assert done.returncode == 2
        assert "leave out --master" in done.stderr, done.stderr


async def test_the_bridge_waits_for_a_master_as_nodes_do(tmp_path: Path) -> None:
    """And then reads its parameters."""
    port = free_port()
    words = ("bridge", "ros1", "--agent", f"0x{'1' * 40}", "--ros-master-uri", f"http://127.0.0.1:{port}")
    variables = {"AIRA_DATA_DIR": str(tmp_path), "AIRA_CONNECT": f"tcp/127.0.0.1:{free_port()}"}
    with Serving(*AIRA, *words, says="waiting for a ROS master", variables=variables) as bridge:
        async with RosMaster("127.0.0.1", port, Drops()) as master:
            await until(lambda: "the ROS master answers" in bridge.log(), what="its parameters")
            await until(lambda: "liability" in master.parameters, what="the settings as parameters")

"""`aira foxglove`: its commands, its errors, its layouts."""

from __future__ import annotations

import json
import socket
from typing import TYPE_CHECKING, Any

import pytest

from bridges.foxglove import sources
from bridges.foxglove.cli import LAYOUTS
from mesh.errors import ConfigurationError, NetworkUnavailable, PortUnavailable
from schemas.keys import ReadingKey
from tests.support.commands import AIRA, Serving, invoke, refused
from tests.support.foxglove.viewer import viewing
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

ROBOT = "0x" + "11" * 20
PANELS = {"Plot", "RawMessages", "StateTransitions", "RosOut", "SourceInfo", "Image"}


async def test_the_command_shows_what_an_agent_publishes(router: EmbeddedRouter) -> None:
    listen = ("--connect", router.endpoint, "--listen", "127.0.0.1:0")
    async with Serving(*AIRA, "foxglove", "agent", ROBOT, *listen, says="ws://") as command:
        (url,) = [word.rstrip(",") for word in command.log().split() if word.startswith("ws://")]
        assert router.session is not None
        async with viewing(url) as viewer:
            assert viewer.info["name"] == f"agent {ROBOT}"

            def seen() -> bool:
                assert router.session is not None
                router.session.put(str(ReadingKey(ROBOT, "/battery")), b'{"left": 0.5}', encoding="application/json")
                return bool(viewer.values("/reading/battery"))

            await until(seen)
            assert viewer.values("/reading/battery")[0] == {"left": 0.5}


def test_other_machines_are_refused_without_tls_and_token() -> None:
    done = invoke("foxglove", "market", "--listen", "0.0.0.0:0")
    assert "--token-file" in refused(done, ConfigurationError, "0.0.0.0")


def test_a_port_that_is_taken_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = invoke("foxglove", "market", "--listen", f"127.0.0.1:{port}")
    assert "--listen" in refused(done, PortUnavailable, str(port))


def test_a_short_token_is_refused(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("short")
    refused(invoke("foxglove", "market", "--listen", "127.0.0.1:0", "--token-file", token), "invalid-options", token)


def test_without_a_router_it_fails() -> None:
    lacking = ("--connect", "tcp/127.0.0.1:9", "--connect-timeout", "0.1", "--listen", "127.0.0.1:0")
    refused(invoke("foxglove", "market", *lacking), NetworkUnavailable)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_is_one_that_foxglove_imports(name: str) -> None:
    done = invoke("foxglove", "layout", name, "--plot", "/temperature.data", "--image", "/camera", "--image", "/back")
    layout = json.loads(done.stdout)
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert {panel.partition("!")[0] for panel in panels} <= PANELS
    assert [path["value"] for path in panels["Plot!values"]["paths"]] == ["/temperature.data"]
    images = [panel["imageMode"]["imageTopic"] for name, panel in panels.items() if name.startswith("Image!")]
    assert images == ["/camera", "/back"]


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_topics_of_a_layout_are_shown(name: str) -> None:
    known = {sources.LOG, sources.JOB, sources.PROGRESS, sources.STATUS, sources.COUNTS}
    known |= {f"/market/{kind}" for kind in ("demand", "result")}
    panels = json.loads(invoke("foxglove", "layout", name).stdout)["configById"]
    used = {path.partition(".")[0] for panel in panels.values() for path in topics(panel)}
    assert used
    assert used <= known


def test_a_layout_is_saved_to_a_new_file(tmp_path: Path) -> None:
    path = tmp_path / "layout.json"
    assert invoke("foxglove", "layout", "job", "--out", path).returncode == 0
    assert json.loads(path.read_text())["layout"]
    refused(invoke("foxglove", "layout", "job", "--out", path), "file-exists")


def leaves(layout: Any) -> Iterator[str]:
    """The panels in an arrangement."""
    if isinstance(layout, str):
        yield layout
        return
    assert layout["direction"] in ("row", "column")
    yield from leaves(layout["first"])
    yield from leaves(layout["second"])


def topics(panel: dict[str, Any]) -> Iterator[str]:
    """The paths that a panel shows."""
    yield from (path["value"] for path in panel.get("paths", ()))
    yield from (panel[name] for name in ("topicPath", "topicToRender") if name in panel)

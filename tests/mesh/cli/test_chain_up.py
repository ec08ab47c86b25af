"""`aira chain up`, as a process of its own, by anvil and embedded."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from mesh.chain import XRT, Chain
from mesh.cli import main
from mesh.dev.development import serve_chain
from mesh.errors import ConfigurationError
from mesh.settings import Settings
from tests.support.cli.served_chain import columns
from tests.support.commands import AIRA, SOON, Serving, aira, invoke, refused
from tests.support.development import variables_of
from tests.support.peers import require
from tests.support.ports import answers, free_port
from tests.support.processes import is_alive
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from click.testing import Result

NOBODY = "0x00000000000000000000000000000000000000AA"


def up(folder: Path, *options: str | Path, port: int, says: str = "password ", **variables: str) -> Serving:
    arguments = ("chain", "up", "--port", str(port), "--data-dir", folder, *options)
    return Serving(*AIRA, *arguments, says=says, variables=variables)


def failing(*options: str | Path, **variables: str) -> Result:
    return CliRunner().invoke(main, ["chain", "up", *map(str, options)], env=dict(variables))


def child_of(pid: int) -> int:
    """The one process that a process has started."""
    (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(child)


def test_anvil_on_the_path_is_used_and_stopped_with_the_command(tmp_path: Path, on_path: dict[str, str]) -> None:
    port = free_port()
    with up(tmp_path, port=port, **on_path) as server:
        said = columns(server.log())
        assert said["engine"].startswith("anvil (")
        assert said["chain"] == f"http://127.0.0.1:{port}"
        anvil = child_of(server.pid)
        person = variables_of("person", tmp_path, url=said["chain"], data_dir=str(tmp_path / "person"))
        assert "anvil/" in invoke("chain", "status", **person).stdout
        assert invoke("xrt", "transfer", NOBODY, "1.5", **person).returncode == 0
        assert invoke("xrt", "balance", **person).stdout == "998.5 XRT\n"
        code, seconds = server.end(signal.SIGINT)
        assert (code, seconds < SOON) == (0, True), server.log()
        assert "Traceback" not in server.log()
    assert not is_alive(anvil)
    assert not answers(port)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
def test_anvil_does_not_outlive_a_command_that_is_killed(tmp_path: Path) -> None:
    port = free_port()
    with up(tmp_path, "--anvil", require("anvil"), port=port) as server:
        anvil = child_of(server.pid)
        server.kill()
        wait_until(lambda: not is_running(anvil) and not answers(port), what="the end of anvil")


@pytest.mark.full
def test_a_crash_of_anvil_is_logged_and_ends_the_command(tmp_path: Path) -> None:
    with up(tmp_path, "--anvil", require("anvil"), port=free_port()) as server:
        os.kill(child_of(server.pid), signal.SIGKILL)
        wait_until(lambda: not is_running(server.pid), what="the end of the command")
        assert "signal 9 [node-ended]\n" in server.log()
        assert "Traceback" not in server.log()
        assert server.wait() == 1


def is_running(pid: int) -> bool:
    """Whether a process has not ended; one that has is a zombie until its parent looks."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_chain_is_kept_in_a_file(tmp_path: Path) -> None:
    options = ("--anvil", require("anvil"), "--state", tmp_path / "chain.json", "--json")
    announced = []
    for _ in range(2):
        with up(tmp_path, *options, port=0, says="passwordFile") as server:
            announced.append(json.loads(server.log().splitlines()[0]))
            status = invoke("chain", "status", "--json", AIRA_WEB3_HTTP_PROVIDER=announced[-1]["chain"])
            announced[-1]["block"] = json.loads(status.stdout)["blockNumber"]
            code, _ = server.end(signal.SIGTERM)
            assert code == 0
    where = ("chain", "webSocket")
    first, second = ({name: fact for name, fact in facts.items() if name not in where} for facts in announced)
    assert first == second


def test_the_embedded_chain_is_used_without_anvil(tmp_path: Path) -> None:
    with up(tmp_path, "--json", port=0, says="passwordFile", PATH="/nowhere:/usr/bin:/bin") as server:
        announced = json.loads(server.log().splitlines()[0])
        assert announced["engine"] == "embedded"
        assert set(announced["accounts"]) == {"provider", "robot", "person"}
        keyfile = Path(announced["accounts"]["robot"]["keyfile"])
        assert keyfile.is_file()
        status = invoke("chain", "status", "--json", AIRA_WEB3_HTTP_PROVIDER=announced["chain"])
        assert json.loads(status.stdout)["factory"] == announced["factory"]


@pytest.mark.full
def test_the_embedded_chain_can_be_selected(tmp_path: Path, on_path: dict[str, str]) -> None:
    with up(tmp_path, "--engine", "embedded", port=0, **on_path) as server:
        assert columns(server.log())["engine"] == "embedded"


def test_a_missing_anvil_is_one_clear_line(tmp_path: Path) -> None:
    hint = refused(failing("--engine", "anvil", PATH=str(tmp_path)), "anvil-missing")
    assert "--engine embedded" in hint
    refused(failing("--anvil", tmp_path / "anvil"), ConfigurationError, tmp_path / "anvil")


def test_the_embedded_chain_has_no_state_file(tmp_path: Path) -> None:
    state = ("--state", tmp_path / "chain.json")
    assert "--anvil FILE" in refused(failing(*state, PATH=str(tmp_path)), "anvil-missing", "--state")
    refused(failing(*state, "--engine", "embedded"), "anvil-missing", "--engine embedded")


def test_an_invalid_state_file_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "state.json").write_text("garbage")
    options = ("--anvil", require("anvil"), "--state", tmp_path / "state.json", "--port", "0", "--data-dir", tmp_path)
    refused(failing(*options), ConfigurationError)


async def test_waiting_for_an_unmined_transaction_can_be_interrupted_and_it_is_not_sent_twice(tmp_path: Path) -> None:
    settings = Settings(data_dir=str(tmp_path))
    anvil = require("anvil")
    async with serve_chain(settings, host="127.0.0.1", port=0, block_time=None, anvil=anvil) as served:
        person = variables_of("person", tmp_path, url=served.url, data_dir=str(tmp_path / "person"))
        command = ("xrt", "transfer", NOBODY, "2")
        async with Chain(served.url) as chain:
            await chain.node.request("evm_setAutomine", False)
            says = "waiting until the transaction is mined"
            async with Serving(*AIRA, *command, says=says, variables=person) as waiting:
                code, seconds = await asyncio.to_thread(waiting.end, signal.SIGINT)
                assert (code, seconds < SOON) == (130, True), waiting.log()
                assert "Traceback" not in waiting.log()
            assert await chain.tokens.balance(NOBODY) == 0
            await chain.node.request("evm_setAutomine", True)
            done = await asyncio.to_thread(aira, *command, **person)
            assert done.returncode == 0, done.stderr
            assert await chain.tokens.balance(NOBODY) == 2 * XRT

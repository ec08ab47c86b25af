"""Commands that serve, as separate processes that talk to each other, and their errors."""

from __future__ import annotations

import json
import re
import signal
import socket
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mesh.chain.errors import UnknownName
from mesh.errors import AiraError, InputError
from mesh.recording import open_objective
from schemas import cid_of_file
from tests.support.commands import AIRA, SOON, Interrupted, Serving, aira, invoke, refused
from tests.support.development import variables_of
from tests.support.objectives import objective
from tests.support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator
    from subprocess import CompletedProcess

EXAMPLES = Path(__file__).parents[3] / "examples" / "hello_mesh"

ORDER = ("--model", "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82", "--objective")
SOME_CID = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"

ROBOT = """
import asyncio, sys
from mesh import Agent

agent = Agent(sys.argv[1])

@agent.on_demand
async def offer(demand):
    await agent.offer(demand)

@agent.on("*")
async def slowly(job, message):
    await asyncio.sleep(0.2)
    job.publish("/done", message.data)
    print("did", message.data, flush=True)

@agent.on_liability
async def phase(phase, liability):
    print("phase", phase, flush=True)

agent.run()
"""


class Development:
    """`aira up` and what other processes need to use it."""

    def __init__(self, folder: Path, *, block_time: str = "0.3") -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        arguments = ("--listen", self.endpoint, "--port", str(self.port), "--data-dir", folder)
        self.up = Serving(*AIRA, "up", *arguments, "--block-time", block_time, says="provider    0x")

    def variables(self, role: str) -> dict[str, str]:
        state = str(self.folder / "state")
        return variables_of(role, self.folder, url=self.url, connect=self.endpoint, data_dir=state)

    def demand(self, *arguments: str | Path) -> CompletedProcess[str]:
        return aira("demand", *arguments, **self.variables("person"))

    def refused(self, error: type[AiraError] | str, *arguments: str | Path, value: object = "") -> str:
        """Assert that a demand of the person is refused; the hint."""
        return refused(invoke("demand", *arguments, "--json", **self.variables("person")), error, value)

    def agent(self, script: Path, *arguments: str, says: str) -> Serving:
        return Serving(sys.executable, script, *arguments, says=says, variables=self.variables("robot"))


@pytest.fixture(scope="module")
def development(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Development]:
    development = Development(tmp_path_factory.mktemp("up"))
    with development.up:
        yield development


def test_a_job_is_done_and_paid_between_processes(development: Development, tmp_path: Path) -> None:
    out = tmp_path / "new" / "result.mcap"
    order = ("--model", cid_of_file(EXAMPLES / "model.md"), "--objective", EXAMPLES / "blink.mcap", "--cost", "1000wn")
    watcher = Serving(
        sys.executable,
        EXAMPLES / "agent.py",
        says="watching",
        variables={"AIRA_CONNECT": development.endpoint},
    )
    with watcher, development.agent(EXAMPLES / "robot.py", says="account 0x") as robot:
        done = development.demand(*order, "--out", out)
        assert (done.returncode, without_silence(done.stderr)) == (0, [])
        first, checked, posted, *happened, end, kept = done.stdout.splitlines()
        assert first.startswith("demand by 0x")
        assert checked.startswith(f"objective {cid_of_file(EXAMPLES / 'blink.mcap')}: ")
        assert posted.startswith("posted ")
        assert any(re.fullmatch(r"contract 0x\w{40} with 0x\w{40}", line) for line in happened)
        assert end == f"paid, result {cid_of_file(out)}"
        assert kept == f"recording {out}"
        assert robot.log().count("the lamp is on") == 3
        watcher.wait_until_said("you would pay 1000 for")
        again = development.demand(*order, "--json")
        summed = json.loads(again.stdout.splitlines()[-1])
        assert set(summed) == {"liability", "robot", "success", "result", "recording"}
        assert summed["success"]
        code, seconds = robot.end(signal.SIGINT)
        assert code == 0
        assert seconds < SOON
        assert "Traceback" not in robot.log()


def without_silence(errors: str) -> list[str]:
    """The lines on stderr, but for the one that says that a busy machine's robot has not offered yet."""
    return [line for line in errors.splitlines() if not line.startswith("no robot has offered or declined yet; ")]


def test_a_killed_robot_continues_its_job_after_a_restart(development: Development, tmp_path: Path) -> None:
    script, model, path = tmp_path / "robot.py", tmp_path / "model", tmp_path / "job.mcap"
    script.write_text(ROBOT)
    model.write_text("a slow robot")
    words = [str(number) for number in range(12)]
    path.write_bytes(objective(*(("/say", word) for word in words), step_ns=0))
    with ExitStack() as stack:
        robot = stack.enter_context(development.agent(script, cid_of_file(model), says="account 0x"))
        person = stack.enter_context(
            Serving(
                *AIRA,
                *("demand", "--model", cid_of_file(model), "--objective", path, "--out", tmp_path / "result.mcap"),
                says="contract 0x",
                variables=development.variables("person"),
            )
        )
        robot.wait_until_said("did 7")
        robot.kill()
        killed = did(robot)
        robot.start()
        person.wait_until_said("recording ")
        assert "paid, result" in person.log()
        resumed = did(robot)
    assert resumed[-1] == words[-1]
    assert resumed[0] != "0", "the ledger knew how far it was"
    assert int(resumed[0]) <= int(killed[-1]) + 1, "nothing is left out"
    recording = open_objective(tmp_path / "result.mcap")
    assert {message.topic for message in recording.messages()} == {"/say", "/done"}


def did(robot: Serving) -> list[str]:
    return re.findall(r"^did (\d+)$", robot.log(), re.MULTILINE)


def test_the_servers_run_as_separate_processes(tmp_path: Path) -> None:
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    router = Serving(*AIRA, "router", "--listen", endpoint, says="listens at")
    chain = Serving(*AIRA, "chain", "up", "--port", str(port), "--data-dir", tmp_path, says="password ")
    with router, chain:
        assert f"chain       http://127.0.0.1:{port}" in chain.log()
        variables = variables_of("provider", tmp_path, url=f"http://127.0.0.1:{port}", connect=endpoint)
        with Serving(*AIRA, "provider", says="serves airalab", variables=variables) as provider:
            for server in (provider, chain, router):
                code, seconds = server.end(signal.SIGINT)
                assert (code, seconds < SOON) == (0, True), server.log()
                assert "Traceback" not in server.log()


def test_ctrl_c_ends_up(tmp_path: Path) -> None:
    development = Development(tmp_path, block_time="0.05")
    with development.up as up:
        code, seconds = up.end(signal.SIGINT)
        assert (code, seconds < SOON) == (0, True), up.log()
        assert "Traceback" not in up.log()


def test_ctrl_c_stops_waiting_for_a_contract(development: Development) -> None:
    interrupted = Interrupted("demand", *ORDER, SOME_CID, at="posted ", variables=development.variables("person"))
    assert interrupted.code == 130
    nobody_has_it, stays_open = interrupted.errors.splitlines()
    assert SOME_CID in nobody_has_it
    assert "aira order withdraw" in stays_open
    assert interrupted.seconds < SOON


@pytest.mark.parametrize(
    ("order", "error", "value"),
    [
        ((*ORDER, "blnk.mcap"), "not-a-file-or-cid", "'blnk.mcap'"),
        (("--model", "blink", "--objective", SOME_CID), InputError, "'blink'"),
        (("--model", "no.model.3.robonomics.eth", "--objective", SOME_CID), UnknownName, "no.model.3.robonomics.eth"),
        ((*ORDER, SOME_CID, "--cost", str(10**30)), "balance-too-low", "XRT"),
        ((*ORDER, SOME_CID, "--cost", "1wei"), "unknown-token", "'wei'"),
        ((*ORDER, SOME_CID, "--validator-fee", "1"), "invalid-options", "--validator"),
    ],
)
def test_an_invalid_order_is_one_clear_line(
    development: Development, order: tuple[str, ...], error: type[AiraError], value: str
) -> None:
    development.refused(error, *order, value=value)


def test_an_unwritable_recording_is_an_error_before_anything_is_paid(development: Development, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "result.mcap"
    development.refused("file-unwritable", *ORDER, SOME_CID, "--out", out, value=out)


def test_ctrl_c_stops_waiting_for_a_router() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unfriendly:
        endpoint = f"tcp/127.0.0.1:{unfriendly.getsockname()[1]}"
        variables = {"AIRA_CONNECT": endpoint, "AIRA_CONNECT_TIMEOUT": "-1"}
        with Serving(sys.executable, EXAMPLES / "agent.py", says="", variables=variables) as waiting:
            unfriendly.settimeout(30)
            for _ in range(2):
                unfriendly.accept()[0].close()
            code, seconds = waiting.end(signal.SIGINT)
            assert (code, seconds < SOON) == (0, True), waiting.log()
            assert "Traceback" not in waiting.log()

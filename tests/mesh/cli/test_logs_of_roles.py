"""The logs of roles that are processes of their own and log in JSON, as `aira logs` has them and as they write them."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mesh.errors import public_text
from schemas import cid_of_file
from tests.support.cli.following import Follower
from tests.support.commands import AIRA, SECONDS, Serving, aira, invoke, refused
from tests.support.development import variables_of
from tests.support.orders import ROBOT
from tests.support.ports import free_port
from tests.support.waiting import wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.routers import EmbeddedRouter

EXAMPLES = Path(__file__).parents[3] / "examples" / "hello_mesh"

PHASE_EVENTS = ("job-accepted", "job-ready", "job-started", "job-finished", "job-finalized")

ROBOT_CODE = """
import logging, sys
from mesh import Agent

log = logging.getLogger("lamp")
agent = Agent(sys.argv[1])

@agent.on_demand
async def offer(demand):
    await agent.offer(demand)

@agent.on("/blink")
async def blink(job, message):
    log.info("the lamp\\nis on \\x1b[2J")

@agent.on_liability
async def phase(phase, liability):
    1 / 0

agent.run()
"""


class JsonMarket:
    """`aira up` and a robot, each a process that logs in JSON."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint, self.port = f"tcp/127.0.0.1:{free_port()}", free_port()
        self.up = self.serving(*AIRA, "up", "--listen", self.endpoint, "--port", str(self.port), says="router tcp")
        script = folder / "robot.py"
        script.write_text(ROBOT_CODE)
        model = cid_of_file(EXAMPLES / "model.md")
        self.robot = self.serving(sys.executable, script, model, says="account 0x", role="robot")
        self._done = ""

    def serving(self, *command: str | Path, says: str, role: str = "provider") -> Serving:
        return Serving(*command, says=says, variables=self.variables(role) | {"AIRA_LOG_FORMAT": "json"})

    def variables(self, role: str) -> dict[str, str]:
        return variables_of(role, self.folder, url=f"http://127.0.0.1:{self.port}", connect=self.endpoint)

    def address(self, role: str) -> str:
        found: str = invoke("account", "show", "--json", **self.variables(role)).stdout
        return str(json.loads(found)["address"])

    def logs(self, role: str, *options: str) -> list[dict[str, Any]]:
        done = invoke("logs", self.addresses[role], "--json", *options, AIRA_CONNECT=self.endpoint)
        assert (done.returncode, done.stderr) == (0, "")
        return [json.loads(line) for line in done.stdout.splitlines()]

    @property
    def job(self) -> str:
        """The address of the contract of a job that is done and paid, the same for all tests."""
        if not self._done:
            self._done = self.do_a_job()
        return self._done

    def do_a_job(self) -> str:
        """Have a job done and paid; the address of its contract."""
        order = ("--model", cid_of_file(EXAMPLES / "model.md"), "--objective", EXAMPLES / "blink.mcap", "--cost", "1wn")
        done = invoke("demand", *order, **self.variables("person"))
        assert done.returncode == 0, done.stderr
        found = re.search(r"contract (0x\w{40})", done.stdout)
        assert found
        wait_until(lambda: self._has_noted_the_end(found[1]), what="the end in the robot's log", seconds=SECONDS)
        return found[1]

    def _has_noted_the_end(self, liability: str) -> bool:
        """Whether the robot has logged the end, and the failure of its handler that hears of it last."""
        names = [event.get("event") for event in self.logs("robot", "--liability", liability)]
        return "job-finalized" in names and names[-1] != "job-finalized"

    @property
    def addresses(self) -> dict[str, str]:
        said = self.robot.log()
        (account, *_) = [json.loads(line) for line in said.splitlines() if "account 0x" in line]
        up = next(json.loads(line) for line in self.up.log().splitlines() if '"provider"' in line)
        return {"robot": account["address"], "provider": up["provider"]}


@pytest.fixture(scope="module")
def market(tmp_path_factory: pytest.TempPathFactory) -> Iterator[JsonMarket]:
    market = JsonMarket(tmp_path_factory.mktemp("market"))
    with market.up, market.robot:
        yield market


def test_the_events_of_a_job_are_found_by_its_contract_with_agent_and_provider(market: JsonMarket) -> None:
    liability, other = market.job, market.do_a_job()

    def of(role: str) -> list[dict[str, Any]]:
        return market.logs(role, "--liability", liability.lower())

    wait_until(
        lambda: "job-finalized" in {event.get("event") for event in of("robot")}, what="the end", seconds=SECONDS
    )
    worked, provided = of("robot"), of("provider")
    for events in (worked, provided):
        assert {event["liability"] for event in events} == {liability} != {other}
    names = [event.get("event") for event in worked]
    for name in PHASE_EVENTS:
        assert names.count(name) == 1, names
    assert [event["message"] for event in worked].count("the lamp\nis on \x1b[2J") == 3
    failures = [event for event in worked if event["level"] == "error"]
    assert {event["error"] for event in failures} == {"ZeroDivisionError: division by zero"}
    assert all("in phase\n" in event["trace"] for event in failures)
    assert [event["event"] for event in provided] == ["contract-created", "contract-finalized"]
    assert len(provided[0]["demand"]) == len(provided[0]["offer"]) == 64
    assert {(event["role"], event["address"]) for event in provided} == {("provider", market.addresses["provider"])}

    for server in (market.up, market.robot):
        lines = [json.loads(line) for line in server.log().splitlines()]
        assert all({"time", "level", "logger", "message", "role"} <= line.keys() for line in lines)
        received = [line for line in lines if line.get("liability") == liability]
        assert [line["message"] for line in received] == [
            event["message"] for event in (worked if server is market.robot else provided)
        ]


def test_plain_logs_equal_the_roles_own_log_without_control_characters(market: JsonMarket) -> None:
    liability = market.job
    done = invoke("logs", market.addresses["robot"], "--liability", liability, AIRA_CONNECT=market.endpoint)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert all(line.isprintable() for line in lines)
    assert [line for line in lines if line.endswith(rf" INFO    {liability}: the lamp\nis on \x1b[2J")]
    events = [line for line in lines if not line.startswith("    | ")]
    assert all(re.match(rf"\d\d:\d\d:\d\d (INFO   |ERROR  ) {liability}: ", line) for line in events)


def test_events_are_filtered_by_level_and_number_of_lines(market: JsonMarket) -> None:
    assert market.job
    assert {event["level"] for event in market.logs("robot", "--level", "error")} == {"error"}
    assert len(market.logs("robot", "--lines", "3")) == 3
    assert market.logs("robot", "--lines", "0") == []
    newest = market.logs("robot", "--lines", "1")
    assert newest == market.logs("robot")[-1:]


def test_following_continues_after_restarts_of_the_agent(market: JsonMarket) -> None:
    robot = market.addresses["robot"]
    with Follower(robot, "--lines", "1", "--json", endpoint=market.endpoint) as follower:
        follower.until("{")
        liability = market.do_a_job()
        follower.until(f"job-finalized|{liability}")
        market.robot.kill()
        follower.until("aira: no answer; waiting")
        market.robot.start()
        follower.until("aira: answering again")
        follower.until("aira: restarted at ")
        follower.until('"sequence": 1, |account 0x')
        again = market.do_a_job()
        said = follower.until(f"job-finalized|{again}")
        assert follower.interrupt() == 130
    events = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    for address in (liability, again):
        names = [event.get("event") for event in events if event.get("liability") == address]
        for name in PHASE_EVENTS:
            assert names.count(name) == 1, names


def test_the_log_service_can_be_called_with_rpc(market: JsonMarket) -> None:
    done = invoke("rpc", market.addresses["robot"], "logs", "lines=1", "level=info", AIRA_CONNECT=market.endpoint)
    assert done.returncode == 0, done.stderr
    events = [line for line in done.stdout.splitlines() if not line.startswith("    | ")]
    assert len(events) == 1
    assert all(re.match(r"\d\d:\d\d:\d\d (INFO   |ERROR  ) ", line) for line in events)
    wrong = invoke("rpc", market.addresses["robot"], "logs", "lines=many", AIRA_CONNECT=market.endpoint)
    refused(wrong, "invalid-argument", "lines")


def test_the_log_of_an_edge_agent_is_read_by_its_device(router: EmbeddedRouter, tmp_path: Path) -> None:
    command = ("edge", tmp_path / "no-board", "--agent", ROBOT.address.lower(), "--connect", router.endpoint)
    with Serving(*AIRA, *command, says="edge of 0x", variables={"AIRA_LOG_FORMAT": "json"}) as edge:
        edge.wait_until_said("waiting")
        done = invoke("logs", ROBOT.address, "--device", "board", "--json", AIRA_CONNECT=router.endpoint)
        assert done.returncode == 0, done.stderr
        received = [json.loads(line) for line in done.stdout.splitlines()]
        written = [json.loads(public_text(line, longest=len(line))) for line in edge.log().splitlines()]
    assert str(tmp_path) not in done.stdout
    assert [{**one, "sequence": 0} for one in received] == [{**one, "sequence": 0} for one in written[: len(received)]]
    assert {(one["role"], one["address"]) for one in received} == {("edge", ROBOT.address)}
    assert any(one["message"].startswith("edge of 0x") and one["device"] == "board" for one in received)


def test_the_log_of_a_bridge_is_read_by_its_address(router: EmbeddedRouter, tmp_path: Path) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}"
    command = ("bridge", "ipfs", "--api", nowhere, "--web3-http-provider", "", "--web3-ws-provider", "")
    variables = {"AIRA_LOG_FORMAT": "json", "AIRA_CONNECT": router.endpoint, "AIRA_DATA_DIR": str(tmp_path)}
    with Serving(*AIRA, *command, says="carries", variables=variables) as bridge:
        bridge.wait_until_said("warning")
        written = [json.loads(line) for line in bridge.log().splitlines()]
        address = next(one["bridge"] for one in written if "bridge" in one)
        done = invoke("logs", address, "--json", AIRA_CONNECT=router.endpoint)
    received = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one["message"] for one in received][: len(written)] == [one["message"] for one in written]
    assert {(one["role"], one["address"].lower()) for one in received} == {("bridge", address)}


def test_the_error_that_ends_a_server_is_an_event(tmp_path: Path) -> None:
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    for command in (("router", "--listen", "tcp/8.8.8.8:1"), ("edge", "/dev/none", "--agent", ROBOT.address)):
        done = aira(*command, AIRA_LOG_FORMAT="json", AIRA_CONNECT=nowhere, AIRA_CONNECT_TIMEOUT="0.2")
        assert done.returncode in (1, 2)
        received = [json.loads(line) for line in (done.stdout + done.stderr).splitlines()]
        assert received[-1]["level"] == "error"

"""`aira logs`, and servers that log in JSON, as processes of their own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import zenoh

from mesh.identity import Member
from schemas import RpcKey, cid_of_file
from schemas.logs import LogEvent, LogsRead
from tests.support.commands import AIRA, SECONDS, Serving, aira, environment
from tests.support.orders import PERSON, ROBOT, STRANGER
from tests.support.ports import free_port
from tests.support.routers import EmbeddedRouter, client_config
from tests.support.sites import Site

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mesh.identity.roles import Role
    from schemas import Signer

EXAMPLES = Path(__file__).parents[3] / "examples" / "hello_mesh"

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
        self.up = self.serving(*AIRA, "up", "--listen", self.endpoint, "--port", str(self.port), says="router      tcp")
        script = folder / "robot.py"
        script.write_text(ROBOT_CODE)
        model = cid_of_file(EXAMPLES / "model.md")
        self.robot = self.serving(sys.executable, script, model, says="account 0x", role="robot")

    def serving(self, *command: str | Path, says: str, role: str = "provider") -> Serving:
        return Serving(*command, says=says, variables=self.variables(role) | {"AIRA_LOG_FORMAT": "json"})

    def variables(self, role: str) -> dict[str, str]:
        keys = self.folder / "development"
        return {
            "AIRA_CONNECT": self.endpoint,
            "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{self.port}",
            "AIRA_DATA_DIR": str(self.folder),
            "AIRA_KEYFILE": str(keys / f"{role}.json"),
            "AIRA_KEYFILE_PASSWORD_FILE": str(keys / "password"),
            "AIRA_POLL_INTERVAL": "0.1",
        }

    def address(self, role: str) -> str:
        found: str = aira("account", "show", "--json", **self.variables(role)).stdout
        return str(json.loads(found)["address"])

    def logs(self, role: str, *options: str) -> list[dict[str, Any]]:
        done = aira("logs", self.addresses[role], "--json", *options, AIRA_CONNECT=self.endpoint)
        assert (done.returncode, done.stderr) == (0, "")
        return [json.loads(line) for line in done.stdout.splitlines()]

    def do_a_job(self) -> str:
        """Have a job done and paid; the address of its contract."""
        order = ("--model", cid_of_file(EXAMPLES / "model.md"), "--objective", EXAMPLES / "blink.mcap", "--cost", "1wn")
        done = aira("demand", *order, **self.variables("person"))
        assert done.returncode == 0, done.stderr
        found = re.search(r"contract (0x\w{40})", done.stdout)
        assert found
        return found[1]

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


class Follower:
    """`aira logs … --follow` in a process."""

    def __init__(self, *arguments: str, endpoint: str) -> None:
        self._process = subprocess.Popen(
            [*AIRA, "logs", *arguments, "--follow"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment({"AIRA_CONNECT": endpoint, "PYTHONUNBUFFERED": "1"}),
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self.said = ""

    def until(self, words: str, *, once_more: bool = False) -> str:
        """All that it has said, once a line holds all of these words; with `once_more` one that comes now."""
        start = len(self.said) if once_more else 0
        deadline = time.monotonic() + SECONDS
        while not any(all(word in line for word in words.split("|")) for line in self.said[start:].splitlines()):
            assert time.monotonic() < deadline, f"no {words!r} in:\n{self.said}"
            assert self._process.poll() is None, self.said
            assert self._process.stdout is not None
            self.said += (self._process.stdout.read() or b"").decode()
            time.sleep(0.02)
        return self.said

    def interrupt(self) -> int:
        self._process.send_signal(signal.SIGINT)
        return self._process.wait(SECONDS)

    def __enter__(self) -> Follower:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._process.kill()
        self._process.wait(SECONDS)
        if self._process.stdout is not None:
            self._process.stdout.close()


@contextmanager
def pretender(endpoint: str, *events: LogEvent, missed: int = 0) -> Iterator[None]:
    """Somebody who answers for the robot with these events, each time that it is asked."""
    key = str(RpcKey(ROBOT.address, "logs"))
    reply = LogsRead(instance="\x1b[2J", began="\x1b[2J", entries=events, last=1, missed=missed).encode()
    with zenoh.open(client_config(endpoint)) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, reply))
        yield
        queryable.undeclare()


def answer(query: zenoh.Query, key: str, reply: bytes) -> None:
    with query:
        query.reply(key, reply)


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_events_of_a_job_are_found_by_its_contract_with_agent_and_provider(market: JsonMarket) -> None:
    liability = market.do_a_job()
    other = market.do_a_job()

    def of(role: str) -> list[dict[str, Any]]:
        return market.logs(role, "--liability", liability.lower())

    until(lambda: "finalized, paid" in {event["message"] for event in of("robot")})
    worked, provided = of("robot"), of("provider")
    for events in (worked, provided):
        assert {event["liability"] for event in events} == {liability} != {other}
    words = [event["message"].split(",")[0] for event in worked]
    for word in ("incoming", "ready", "running", "complete", "finalized"):
        assert words.count(word) == 1, words
    assert words.count("the lamp\nis on \x1b[2J") == 3
    failures = [event for event in worked if event["level"] == "error"]
    assert {event["error"] for event in failures} == {"ZeroDivisionError: division by zero"}
    assert all("in phase\n" in event["trace"] for event in failures)
    assert [event["message"].split(",")[0] for event in provided] == ["created", "finalized"]
    assert len(provided[0]["demand"]) == len(provided[0]["offer"]) == 64
    assert {(event["role"], event["address"]) for event in provided} == {("provider", market.addresses["provider"])}

    for server in (market.up, market.robot):
        lines = [json.loads(line) for line in server.log().splitlines()]
        assert all({"time", "level", "logger", "message", "role"} <= line.keys() for line in lines)
        told = [line for line in lines if line.get("liability") == liability]
        assert [line["message"] for line in told] == [
            event["message"] for event in (worked if server is market.robot else provided)
        ]


def test_people_read_the_same_as_in_the_roles_own_log_and_nothing_steers_their_terminal(market: JsonMarket) -> None:
    liability = market.do_a_job()
    done = aira("logs", market.addresses["robot"], "--liability", liability, AIRA_CONNECT=market.endpoint)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert all(line.isprintable() for line in lines)
    assert [line for line in lines if line.endswith(rf" INFO    {liability}: the lamp\nis on \x1b[2J")]
    events = [line for line in lines if not line.startswith("    | ")]
    assert all(re.match(rf"\d\d:\d\d:\d\d (INFO   |ERROR  ) {liability}: ", line) for line in events)


def test_levels_and_lines_select(market: JsonMarket) -> None:
    market.do_a_job()
    assert {event["level"] for event in market.logs("robot", "--level", "error")} == {"error"}
    assert len(market.logs("robot", "--lines", "3")) == 3
    assert market.logs("robot", "--lines", "0") == []
    newest = market.logs("robot", "--lines", "1")
    assert newest == market.logs("robot")[-1:]


def test_following_goes_on_over_restarts_of_the_agent(market: JsonMarket) -> None:
    robot = market.addresses["robot"]
    with Follower(robot, "--lines", "1", "--json", endpoint=market.endpoint) as follower:
        follower.until("{")
        liability = market.do_a_job()
        follower.until(f"finalized, paid|{liability}")
        market.robot.kill()
        follower.until("aira: nobody answers now; waiting")
        market.robot.start()
        follower.until("aira: it answers again")
        follower.until("aira: it has begun anew at ")
        follower.until('"sequence": 1, |account 0x')
        again = market.do_a_job()
        said = follower.until(f"finalized, paid|{again}")
        assert follower.interrupt() == 130
    events = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    for address in (liability, again):
        words = [event["message"].split(",")[0] for event in events if event.get("liability") == address]
        for word in ("incoming", "ready", "running", "complete", "finalized"):
            assert words.count(word) == 1, words


def test_following_goes_on_over_a_restart_of_the_router(router: EmbeddedRouter) -> None:
    with (
        pretender(router.endpoint, event("hello")),
        Follower(ROBOT.address, endpoint=router.endpoint) as follower,
    ):
        follower.until("hello")
        router.stop()
        follower.until("aira: nobody answers now; waiting")
        router.start()
        follower.until("aira: it answers again")
        follower.until("hello", once_more=True)
        assert follower.interrupt() == 130


def event(message: str, **fields: Any) -> LogEvent:
    return LogEvent(**({"time": "2026-01-01T00:00:00.000Z", "level": "info", "logger": "x"} | fields), message=message)


def test_what_a_hostile_agent_says_steers_no_terminal(router: EmbeddedRouter) -> None:
    wild = "\x1b[2J\x9b\r\u202e\x7f\x00\n"
    hostile = event(wild, time=wild, level=wild, logger=wild, liability=wild, error=wild, trace=f"a{wild}b{wild}")
    with pretender(router.endpoint, hostile):
        for options in ((), ("--json",)):
            done = aira("logs", ROBOT.address, *options, AIRA_CONNECT=router.endpoint)
            assert done.returncode == 0
            assert all(line.isprintable() for line in done.stdout.split("\n"))
            assert done.stdout.count("\n") == (1 if options else 5), done.stdout
        assert json.loads(done.stdout)["message"] == wild
        with Follower(ROBOT.address, endpoint=router.endpoint) as follower:
            assert "\x1b" not in follower.until("    | ")


def test_missed_events_are_told(router: EmbeddedRouter) -> None:
    with (
        pretender(router.endpoint, event("hello"), missed=1_234),
        Follower(ROBOT.address, endpoint=router.endpoint) as follower,
    ):
        follower.until("aira: missed 1,234 events, which came faster than they could be read")


def test_an_answer_that_can_not_be_read_is_one_clear_line(router: EmbeddedRouter) -> None:
    key = str(RpcKey(ROBOT.address, "logs"))
    with zenoh.open(client_config(router.endpoint)) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, b"\x1b[2J"))
        done = aira("logs", ROBOT.address, AIRA_CONNECT=router.endpoint)
        queryable.undeclare()
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("aira: logs: the answer can't be read: ")
    assert done.stderr.strip().isprintable()


@pytest.mark.parametrize("options", [(), ("--follow",), ("--device", "board")])
def test_nobody_there_is_one_clear_line(router: EmbeddedRouter, options: tuple[str, ...]) -> None:
    done = aira("logs", ROBOT.address, *options, AIRA_CONNECT=router.endpoint)
    assert (done.returncode, done.stdout) == (1, "")
    line, hint = done.stderr.splitlines()
    assert line.startswith("aira: nobody tells its log at aira/agent/0x")
    assert hint.startswith("      is it running")


@pytest.mark.parametrize(
    "wrong", [("0x12",), (ROBOT.address, "--liability", "0x12"), (ROBOT.address, "--level", "loud")]
)
def test_what_can_not_be_asked_is_refused_before(wrong: tuple[str, ...]) -> None:
    assert aira("logs", *wrong).returncode == 2


def test_ctrl_c_ends_the_waiting_for_an_answer(router: EmbeddedRouter) -> None:
    """Somebody who never answers."""
    queries: list[zenoh.Query] = []
    with zenoh.open(client_config(router.endpoint)) as session:
        queryable: Any = session.declare_queryable(str(RpcKey(ROBOT.address, "logs")), queries.append)
        command = ["logs", ROBOT.address, "--timeout", "60"]
        with subprocess.Popen(
            [*AIRA, *command], env=environment({"AIRA_CONNECT": router.endpoint}), stderr=subprocess.PIPE
        ) as asking:
            until(lambda: queries)
            asking.send_signal(signal.SIGINT)
            assert asking.wait(SECONDS) == 130
            assert asking.stderr is not None
            assert asking.stderr.read() == b""
        queryable.undeclare()
        queries.clear()


def test_an_edge_agent_tells_its_log_by_its_device(router: EmbeddedRouter, tmp_path: Path) -> None:
    command = ("edge", tmp_path / "no-board", "--agent", ROBOT.address.lower(), "--connect", router.endpoint)
    with Serving(*AIRA, *command, says="edge of 0x", variables={"AIRA_LOG_FORMAT": "json"}) as edge:
        until(lambda: "waiting" in edge.log())
        done = aira("logs", ROBOT.address, "--device", "board", "--json", AIRA_CONNECT=router.endpoint)
        assert done.returncode == 0, done.stderr
        told = [json.loads(line) for line in done.stdout.splitlines()]
        written = [json.loads(line) for line in edge.log().splitlines()]
    assert [{**one, "sequence": 0} for one in told] == [{**one, "sequence": 0} for one in written[: len(told)]]
    assert {(one["role"], one["address"]) for one in told} == {("edge", ROBOT.address)}
    assert any(one["message"].startswith("edge of 0x") and one["device"] == "board" for one in told)


def test_a_bridge_tells_its_log_by_its_address(router: EmbeddedRouter, tmp_path: Path) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}"
    command = ("bridge", "ipfs", "--api", nowhere, "--web3-http-provider", "", "--web3-ws-provider", "")
    variables = {"AIRA_LOG_FORMAT": "json", "AIRA_CONNECT": router.endpoint, "AIRA_DATA_DIR": str(tmp_path)}
    with Serving(*AIRA, *command, says="carries", variables=variables) as bridge:
        until(lambda: "warning" in bridge.log())
        written = [json.loads(line) for line in bridge.log().splitlines()]
        address = next(one["bridge"] for one in written if "bridge" in one)
        done = aira("logs", address, "--json", AIRA_CONNECT=router.endpoint)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one["message"] for one in told][: len(written)] == [one["message"] for one in written]
    assert {(one["role"], one["address"].lower()) for one in told} == {("bridge", address)}


def test_a_servers_last_word_is_an_event_too(tmp_path: Path) -> None:
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    for command in (("router", "--listen", "tcp/8.8.8.8:1"), ("edge", "/dev/none", "--agent", ROBOT.address)):
        done = aira(*command, AIRA_LOG_FORMAT="json", AIRA_CONNECT=nowhere, AIRA_CONNECT_TIMEOUT="0.2")
        assert done.returncode in (1, 2)
        told = [json.loads(line) for line in (done.stdout + done.stderr).splitlines()]
        assert told[-1]["level"] == "error"


def test_on_a_closed_site_an_operator_may_look_and_an_agent_may_not(tmp_path: Path) -> None:
    site = Site(tmp_path)
    people: dict[str, tuple[Signer, Role]] = {
        "robot": (ROBOT, "agent"),
        "person": (PERSON, "agent"),
        "chief": (STRANGER, "operator"),
    }
    folders = {
        name: site.enlist(Member(name=name, address=signer.address.lower(), roles=(role,)))
        for name, (signer, role) in people.items()
    }

    def credentials(name: str) -> dict[str, str]:
        own = folders[name]
        return {
            "AIRA_CONNECT": site.endpoint,
            "AIRA_TLS_CA": str(own.ca),
            "AIRA_TLS_CERTIFICATE": str(own.certificate),
            "AIRA_TLS_KEY": str(own.key),
        }

    key = str(RpcKey(ROBOT.address, "logs"))
    reply = LogsRead(instance="one", began="", entries=(event("a word of the site"),), last=1).encode()
    with site.open_router("wheel"), zenoh.open(site.client(folders["robot"]).config()) as session:
        queryable: Any = session.declare_queryable(key, lambda query: answer(query, key, reply))
        seen = aira("logs", ROBOT.address, **credentials("chief"))
        assert (seen.returncode, "a word of the site" in seen.stdout) == (0, True), seen.stderr
        hidden = aira("logs", ROBOT.address, **credentials("person"))
        assert (hidden.returncode, hidden.stdout) == (1, "")
        queryable.undeclare()


def test_the_service_can_be_called_as_any_other(market: JsonMarket) -> None:
    done = aira("rpc", market.addresses["robot"], "logs", "lines=1", "level=info", AIRA_CONNECT=market.endpoint)
    assert done.returncode == 0, done.stderr
    events = [line for line in done.stdout.splitlines() if not line.startswith("    | ")]
    assert len(events) == 1
    assert all(re.match(r"\d\d:\d\d:\d\d (INFO   |ERROR  ) ", line) for line in events)
    wrong = aira("rpc", market.addresses["robot"], "logs", "lines=many", AIRA_CONNECT=market.endpoint)
    assert (wrong.returncode, "has to be a whole number" in wrong.stderr) == (2, True)

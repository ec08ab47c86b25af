"""`aira liability hand-back` and `stop`: of a robot at work in a process of its own."""

from __future__ import annotations

import json
import signal
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tests.support.commands import AIRA, Serving, aira, invoke
from tests.support.objectives import objective
from tests.support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import Any

MODEL = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
CUSTOMER = "0x000000000000000000000000000000000000bEEF"
ROBOT = f"""
import asyncio, sys
from mesh import Agent
agent = Agent("{MODEL}")
@agent.on_demand
async def offer(demand):
    await agent.offer(demand)
@agent.on("/go")
async def go(job, message):
    print("begun", flush=True)
    await asyncio.Event().wait()
@agent.on_stop
async def make_safe(job, why):
    print("safe after", why, flush=True)
    await asyncio.sleep(float(sys.argv[1]))
agent.run()
"""


@contextmanager
def ordered(folder: Path, *, safe: float = 0.0) -> Iterator[tuple[str, Serving, Serving, dict[str, dict[str, str]]]]:
    """A job that a robot has begun and never ends: its contract, the processes of demand and robot, the settings.

    The robot is safe `safe` seconds after it was stopped.
    """
    (folder / "robot.py").write_text(ROBOT)
    (folder / "objective.mcap").write_bytes(objective(("/go", "there")))
    endpoint, port, data = f"tcp/127.0.0.1:{free_port()}", str(free_port()), folder / "data"
    keys = data / "development"
    shared = {
        "AIRA_CONNECT": endpoint,
        "AIRA_WEB3_HTTP_PROVIDER": f"http://127.0.0.1:{port}",
        "AIRA_DATA_DIR": str(data),
        "AIRA_KEYFILE_PASSWORD_FILE": str(keys / "password"),
    }
    roles = {role: shared | {"AIRA_KEYFILE": str(keys / f"{role}.json")} for role in ("robot", "person", "provider")}
    words = ("up", "--port", port, "--listen", endpoint, "--data-dir", data, "--engine", "embedded")
    demand = ("demand", "--model", MODEL, "--objective", folder / "objective.mcap", "--cost", "5 XRT", "--json")
    with (
        Serving(*AIRA, *words, says="provider    0x"),
        Serving(sys.executable, folder / "robot.py", str(safe), says="account 0x", variables=roles["robot"]) as robot,
        Serving(*AIRA, *demand, says='"playing"', variables=roles["person"]) as ordering,
    ):
        robot.wait_until_said("begun")
        [job] = json.loads(aira("liability", "list", "--state", "open", "--json", **roles["robot"]).stdout)
        yield job["address"], ordering, robot, roles


def test_an_owner_hands_a_job_back_and_its_customer_is_refunded_and_told_why(tmp_path: Path) -> None:
    with ordered(tmp_path) as (address, ordering, _, roles):
        said = ("--code", "arm-broken", "--why", "the arm is broken")
        for role in ("person", "provider"):
            refused = aira("liability", "hand-back", address, *said, **roles[role])
            assert (refused.returncode, f"may not hand back {address}" in refused.stderr) == (1, True), refused.stderr
        unfit = aira("liability", "hand-back", address, "--code", "Arm Broken", **roles["robot"])
        assert (unfit.returncode, "[invalid-code]" in unfit.stderr) == (2, True), unfit.stderr
        done = aira("liability", "hand-back", address, *said, **roles["robot"])
        assert (done.returncode, done.stdout) == (0, f"handed back {address}\n"), done.stderr
        assert ordering.wait() == 1
        assert "handed back by the robot: the arm is broken (arm-broken); the cost was returned" in ordering.log()
        late = aira("liability", "hand-back", address, **roles["robot"])
        assert (late.returncode, late.stderr) == (0, ""), "to hand it back again changes nothing"


def test_a_job_that_was_stopped_ends_stopped_also_if_its_robot_is_killed_right_after_its_answer(tmp_path: Path) -> None:
    with ordered(tmp_path, safe=50.0) as (address, ordering, robot, roles):
        done = aira("liability", "stop", address, "smoke", **roles["person"])
        robot.end(signal.SIGKILL)
        assert done.returncode == 0, done.stderr
        begun = robot.log().count("begun")
        again = (sys.executable, tmp_path / "robot.py", "0")
        with Serving(*again, says="account 0x", variables=roles["robot"]) as restarted:
            assert ordering.wait() == 1
            assert "stopped by the customer: smoke (stopped)" in ordering.log()
            assert "safe after smoke" in restarted.log()
            assert (begun, restarted.log().count("begun")) == (1, 0)


def test_an_owner_changes_the_price_pauses_stops_and_releases_a_robot_that_runs(tmp_path: Path) -> None:
    with ordered(tmp_path) as (_, ordering, robot, roles):
        own = roles["robot"]

        def control(*words: str) -> dict[str, Any]:
            done = invoke("robot", *words, "--json", **own)
            assert done.returncode == 0, done.stderr
            return dict(json.loads(done.stdout))

        changed = control("set", "--price", "6", "--paused", "true", "--least-price", "5.5", "--refuse", CUSTOMER)
        events = [event["event"] for event in changed["events"]]
        assert events == ["job-offered", "job-begun"]
        assert changed | {"robot": "", "events": []} == {
            "robot": "",
            "price": "6 XRT",
            "paused": True,
            "refuse": [CUSTOMER],
            "leastPrice": "5.5 XRT",
            "held": False,
            "stopped": "",
            "events": [],
            "notify": [],
        }
        listed = invoke("robots", **own).stdout
        assert ("closed" in listed, "6 XRT" in listed) == (True, True), listed
        wrong = invoke("robot", "set", changed["robot"], "--price", "a lot", **own)
        assert (wrong.returncode, "[invalid-amount]" in wrong.stderr) == (2, True), wrong.stderr
        stopped = control("stop", "--why", "smoke")
        assert (stopped["held"], stopped["stopped"]) == (True, "stopped 1 job")
        assert ordering.wait() == 1
        assert "stopped by the robot's side: smoke (robot-stopped)" in ordering.log()
        robot.end(signal.SIGKILL)
        gone = invoke("robot", "show", **own)
        assert (gone.returncode, "[no-answer]" in gone.stderr) == (1, True), gone.stderr
        nobody = invoke("robot", "show", **(own | {"AIRA_KEYFILE": ""}))
        assert (nobody.returncode, "[robot-unknown]" in nobody.stderr) == (2, True), nobody.stderr
        with Serving(sys.executable, tmp_path / "robot.py", "0", says="account 0x", variables=own):
            assert control("show") | {"events": []} == stopped | {"stopped": "", "events": []}
            released = control("release")
            assert (released["held"], released["paused"]) == (False, True)
            assert "takes        no jobs: it is paused\n" in invoke("robot", "show", **own).stdout

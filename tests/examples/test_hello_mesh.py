"""The hello mesh example: what its files are, and that they do what the README says."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from mesh.recording import open_objective
from schemas import EMPTY, cid_of_file
from tests.support.commands import AIRA, Serving, aira, run
from tests.support.lessons import EXAMPLES, as_role, market
from tests.support.ports import free_port

ROOT = Path(__file__).parents[2]
EXAMPLE = EXAMPLES / "hello_mesh"


__all__ = ["market"]


def test_the_readme_names_the_model_as_it_is() -> None:
    named = set(re.findall(r'model="(Qm\w{44})"', (ROOT / "README.md").read_text()))
    assert named == {cid_of_file(EXAMPLE / "model.md")}


def test_the_objective_is_three_blinks() -> None:
    recording = open_objective(EXAMPLE / "blink.mcap")
    assert [(message.topic, message.type) for message in recording.messages()] == [("/blink", EMPTY)] * 3


def test_the_flow_of_the_readme_ends_paid(market: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "result.mcap"
    model = aira("cid", EXAMPLE / "model.md").stdout.strip()
    watching = {"AIRA_CONNECT": market["AIRA_CONNECT"]}
    with (
        Serving(sys.executable, EXAMPLE / "agent.py", says="watching", variables=watching) as greeter,
        Serving(sys.executable, EXAMPLE / "robot.py", says="account 0x", variables=as_role("robot", market)) as robot,
    ):
        order = ("--cost", "1000wn", "--model", model, "--objective", EXAMPLE / "blink.mcap", "--out", out)
        variables = (f"{name}={value}" for name, value in as_role("person", market).items())
        done = run("env", *variables, *AIRA, "demand", *order)
        person, _, posted, *happened, outcome, kept = done.stdout.splitlines()
        assert re.fullmatch(rf"demand by 0x\w{{40}} for {model}", person)
        assert re.fullmatch(r"posted [0-9a-f]{64}, 0\.000001 XRT for any robot, valid until block [\d,]+", posted)
        assert any(re.fullmatch(r"contract 0x\w{40} with 0x\w{40}", line) for line in happened)
        assert (outcome, kept) == (f"paid, result {cid_of_file(out)}", f"recording {out}")
        greeting = f"Hello {person.split()[2]}, you would pay 1000 for {cid_of_file(EXAMPLE / 'blink.mcap')}."
        greeter.wait_until_said(f"{greeting}\n")
        assert greeting in greeter.log().splitlines()
        assert robot.log().count("the lamp is on") == 3
    said = [message.payload for message in open_objective(out).messages() if message.topic == "/led"]
    assert len(said) == 6


def test_an_agent_without_a_router_is_one_clear_line() -> None:
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    done = run(sys.executable, EXAMPLE / "agent.py", AIRA_CONNECT=nowhere, AIRA_CONNECT_TIMEOUT="0.2")
    assert done.returncode == 1
    assert done.stderr.splitlines()[0].startswith(f"aira: no Zenoh router at {nowhere}")
    assert len(done.stderr.splitlines()) == 2

"""The demo's output: its order, odd messages, and a reader that closes its end."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from mesh.dev.demo import JsonNarrator, TextNarrator
from schemas import Empty, String
from tests.support.commands import AIRA, SECONDS, aira, environment
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

STEPS = (
    "A market is founded",
    "  market    Zenoh router at tcp/127.0.0.1:",
    "            factory    0x",
    "  provider  account 0x",
    "  robot     account 0x",
    "  person    account 0x",
    "A person wants work done",
    "  person    holds the objective blink.mcap",
    "  person    will pay 42 XRT for it, and publishes a Demand",
    "  robot     hears the Demand ",
    "  provider  Demand and Offer agree; asks the lighthouse for a contract",
    "A contract holds the money",
    "  contract  liability 0x",
    "  robot     fetches the objective by its CID and examines it",
    "  robot     is ready",
    "The robot works",
    "  robot     plays the objective and records its device",
    *(
        line
        for _ in range(3)
        for line in ("  robot     plays std_msgs/Empty", "  device    ● LED on", "  device    ○ LED ")
    ),
    "  robot     signs the Result: done, recording",
    "The contract pays",
    "  contract  liability is finalized",
    "  robot     had 1,000 XRT, has 1,042 XRT",
    "  person    had 1,000 XRT, has 958 XRT",
    "  person    has the recording Qm",
    "Done in ",
)


def test_the_text_has_the_steps_in_their_order() -> None:
    done = aira("demo")
    assert (done.returncode, done.stderr) == (0, "")
    lines = iter(done.stdout.splitlines())
    for step in STEPS:
        assert any(line.startswith(step) for line in lines), f"{step!r} is missing, or not in its place"


@pytest.mark.full
def test_messages_are_printed_without_control_characters(tmp_path: Path) -> None:
    """An objective may come from anyone; it must not control the terminal."""
    path = tmp_path / "odd.mcap"
    values = (String("red"), String("\x1b[2Jgone\n"), String("x" * 61), String(""), b"\x00\x01", {"a": 1}, Empty())
    path.write_bytes(objective(*(("/odd", value) for value in values), step_ns=0))
    done = aira("demo", "--json", "--objective", path)
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [event["message"] for event in events if event.get("event") == "played"] == [
        "red",
        "\N{REPLACEMENT CHARACTER}[2Jgone\N{REPLACEMENT CHARACTER}",
        "x" * 60 + "…",
        "",
        "2 bytes",
        "{'a': 1}",
        "std_msgs/Empty",
    ]
    colours = [event["colour"] for event in events if event.get("event") == "led" and event["state"] == "on"]
    assert colours[0] == "red"


@pytest.mark.full
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_a_demo_goes_on_after_its_reader_closed_stdout(form: tuple[str, ...]) -> None:
    """As with `aira demo | head`: no traceback, no hanging."""
    pipe = subprocess.PIPE
    with subprocess.Popen([*AIRA, "demo", *form], stdout=pipe, stderr=pipe, env=environment({})) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(timeout=SECONDS) == 0
        assert process.stderr.read() == b""


def test_further_lines_are_indented_and_long_ones_stay_whole(capsys: pytest.CaptureFixture[str]) -> None:
    narrator = TextNarrator()
    narrator.chapter("A chapter")
    narrator.event("robot", "asking", "[b]says[/b]\n" + "0x" * 200)
    assert capsys.readouterr().out == f"\nA chapter\n  robot     [b]says[/b]\n{' ' * 12}{'0x' * 200}\n"


@pytest.mark.parametrize(("paid", "word"), [(True, "paid"), (False, "refunded")])
def test_the_last_line_says_if_the_robot_was_paid(paid: bool, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    TextNarrator().summary(paid=paid, seconds=1.25)
    assert capsys.readouterr().out == f"\nDone in 1.2 s: the job was {word}.\n"


def test_objects_hold_the_facts_without_the_text(capsys: pytest.CaptureFixture[str]) -> None:
    narrator = JsonNarrator()
    narrator.chapter("A chapter")
    narrator.event("robot", "ready", "is ready", liability="0x1")
    narrator.summary(paid=False)
    objects: list[dict[str, Any]] = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert objects == [{"event": "ready", "who": "robot", "liability": "0x1"}, {"paid": False}]

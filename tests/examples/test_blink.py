"""The lessons of blinking: real firmware on a simulated Uno, and every role a process of its own."""

from __future__ import annotations

import itertools
import json
from operator import itemgetter
from typing import TYPE_CHECKING

import pytest

from mesh.recording import open_objective
from schemas import cid_of_file
from schemas.payloads import String
from tests.support.bags import Bag, BagMessage, string
from tests.support.commands import AIRA, aira, run
from tests.support.lessons import EXAMPLES, PROTOCOLS, as_role, at_work, market

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

    from bridges.serial.boards import PinChange

__all__ = ["market"]

HALF = 0.5
"""Seconds that a lamp is on, and off."""


def demand(example: str, objective: str | Path, out: Path, market: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """The person's order, to its end."""
    model = cid_of_file(EXAMPLES / example / "model.md")
    order = ("--cost", "1000wn", "--model", model, "--objective", EXAMPLES / example / objective, "--out", out)
    return run(*AIRA, "demand", *order, **as_role("person", market))


def said_on(recording: Path, topic: str) -> list[tuple[str, int]]:
    """The messages recorded on a topic, with their times in nanoseconds."""
    messages = open_objective(recording).messages()
    return [(String.decode(each.payload).data, each.log_time_ns) for each in messages if each.topic == topic]


def assert_three_blinks(changes: list[PinChange]) -> None:
    """High and low three times, half a second each, by the board's own clock."""
    first = next(index for index, change in enumerate(changes) if change.high)
    blinks = changes[first:]
    assert [change.high for change in blinks] == [True, False] * 3
    for before, after in itertools.pairwise(blinks):
        assert after.at - before.at == pytest.approx(HALF, abs=0.01)


@pytest.mark.parametrize(
    ("example", "name", "line"),
    [
        ("blink", "blink", {"topic": "/blink"}),
        ("blink_arguments", "red", {"topic": "/blink", "value": "red"}),
        ("blink_arguments", "blue", {"topic": "/blink", "value": "blue"}),
        ("blink_arguments", "green", {"topic": "/blink", "value": "green"}),
    ],
)
def test_the_readme_commands_reproduce_the_objectives(
    example: str, name: str, line: dict[str, str], tmp_path: Path
) -> None:
    readme = (EXAMPLES / example / "README.md").read_text()
    lines, made = tmp_path / "lines.jsonl", tmp_path / f"{name}.mcap"
    lines.write_text(json.dumps(line) + "\n")
    done = aira("objective", "pack", lines, "--out", made)
    assert done.returncode == 0, done.stderr
    assert made.read_bytes() == (EXAMPLES / example / f"{name}.mcap").read_bytes()
    assert f"`{name}.mcap`" in readme
    assert cid_of_file(made) in readme


@pytest.mark.sample("protocol")
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_demand_makes_the_lamp_blink_and_is_paid(protocol: str, market: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "result.mcap"
    with at_work("blink", "blink", protocol, market) as uno:
        done = demand("blink", "blink.mcap", out, market)
        assert f"paid, result {cid_of_file(out)}" in done.stdout.splitlines(), done.stdout + done.stderr
        assert_three_blinks(uno.changes(13))
    led = said_on(out, "/led")
    assert [text for text, _ in led] == ["on", "off"] * 3
    assert led == sorted(led, key=itemgetter(1))
    assert led[-1][1] - led[0][1] > HALF * 1e9  # two seconds and a half, were nobody ever late to hear it
    commands = [message.payload for message in open_objective(out).messages() if message.topic == "/blink_led"]
    assert commands == [b""]


@pytest.mark.full
def test_a_ros_bag_makes_the_lamp_blink_as_well(market: dict[str, str], tmp_path: Path) -> None:
    bag, out = tmp_path / "blue.bag", tmp_path / "result.mcap"
    bag.write_bytes(Bag([BagMessage("/blink", string("blue"), 0)], compression="bz2").encode())
    with at_work("blink_arguments", "colours", "frames", market) as uno:
        done = demand("blink_arguments", bag, out, market)
        assert "paid" in done.stdout, done.stdout + done.stderr
        assert_three_blinks(uno.changes(12))
    assert [text for text, _ in said_on(out, "/led")] == ["blue on", "blue off"] * 3


@pytest.mark.full
@pytest.mark.sample("protocol")
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_argument_chooses_the_lamp(protocol: str, market: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "result.mcap"
    with at_work("blink_arguments", "colours", protocol, market) as uno:
        red = demand("blink_arguments", "red.mcap", out, market)
        assert "paid" in red.stdout, red.stdout + red.stderr
        assert_three_blinks(uno.changes(13))
        assert not any(change.high for change in uno.changes(12))
        uno.pins.clear()
        blue = demand("blink_arguments", "blue.mcap", out, market)
        assert "paid" in blue.stdout, blue.stdout + blue.stderr
        assert_three_blinks(uno.changes(12))
        uno.pins.clear()
        green = demand("blink_arguments", "green.mcap", out, market)
        assert "refunded" in green.stdout, green.stdout + green.stderr
        assert green.returncode == 1
        assert "[job-not-done]" in green.stderr
        assert uno.pins == []
    assert [text for text, _ in said_on(out, "/aira/note")] == ["there is no green lamp [job-failed]"]

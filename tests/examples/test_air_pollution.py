"""The lesson of the air pollution sensor: voltages on a simulated Uno's inputs, and the measurements of them."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import pytest

from mesh.recording import open_objective
from tests.support.commands import AIRA, Serving, run
from tests.support.lessons import EXAMPLES, PROTOCOLS, as_role, at_work, market
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["market"]

PLOT = EXAMPLES / "air_pollution" / "plot.py"

VOLTS = {"dust": 0.5, "CO": 1.0, "LPG": 1.5, "methane": 2.0, "smoke": 2.5, "hydrogen": 3.0}


@pytest.mark.full
@pytest.mark.sample("protocol")
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_person_gets_the_measurements_of_the_sensors(protocol: str, market: dict[str, str], tmp_path: Path) -> None:
    out, png = tmp_path / "air.mcap", tmp_path / "air.png"
    watching = {"AIRA_CONNECT": market["AIRA_CONNECT"]}
    with (
        at_work("air_pollution", "air", protocol, market) as uno,
        Serving(*AIRA, "watch", "--readings", says="watching", variables=watching) as watch,
    ):
        for channel, volts in enumerate(VOLTS.values()):
            uno.set_voltage(channel, int(volts * 1000))
        person = EXAMPLES / "air_pollution" / "person.py"
        done = run(sys.executable, person, "--times", "2", "--out", out, **as_role("person", market))
        shown = "reading    /measurements  "
        asyncio.run(until(lambda: shown in watch.log(), what="the reading in `aira watch`", seconds=60))
        watch.wait_until_said("done, for 0x")
        watched = watch.log()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "done, for 0x" in watched
    first = next(line.split(shown)[1] for line in watched.splitlines() if shown in line)
    assert [float(number) for number in first.split(",")[0].split()] == pytest.approx(list(VOLTS.values()), abs=0.02)
    printed = dict(line.rsplit(maxsplit=2)[:2] for line in done.stdout.splitlines() if line.endswith(" V"))
    assert printed.keys() == VOLTS.keys()
    for gas, volts in VOLTS.items():
        assert float(printed[gas]) == pytest.approx(volts, abs=0.02)
    assert [message.topic for message in open_objective(out).messages()] == ["/measurements"] * 2
    drawn = run(sys.executable, PLOT, out, "-o", png)
    assert drawn.stdout == f"{png}: 2 measurements\n", drawn.stderr
    assert png.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


@pytest.mark.parametrize(
    ("messages", "said"),
    [
        ([("/other", "0.1 0.2")], "there are no measurements to draw"),
        ([("/measurements", "0.1 0.2")], "'0.1 0.2' is no measurement: 6 numbers are one"),
        ([("/measurements", "a b c d e f")], "is no measurement"),
    ],
)
def test_a_recording_without_measurements_is_one_clear_line(
    messages: list[tuple[str, str]], said: str, tmp_path: Path
) -> None:
    recording = tmp_path / "other.mcap"
    recording.write_bytes(objective(*messages))
    done = run(sys.executable, PLOT, recording, "-o", tmp_path / "air.png")
    assert done.returncode == 2
    assert said in done.stderr.splitlines()[0]
    assert "Traceback" not in done.stderr

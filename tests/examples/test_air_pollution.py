"""The lesson of the air pollution sensor: voltages on a simulated Uno's inputs, and what the asker gets of them."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest

from tests.support.commands import run
from tests.support.lessons import EXAMPLES, PROTOCOLS, as_role, at_work, market

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["market"]

VOLTS = {"dust": 0.5, "CO": 1.0, "LPG": 1.5, "methane": 2.0, "smoke": 2.5, "hydrogen": 3.0}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_who_asks_for_nothing_is_told_what_the_sensors_measure(
    protocol: str, market: dict[str, str], tmp_path: Path
) -> None:
    with at_work("air_pollution", "air", protocol, market) as uno:
        for channel, volts in enumerate(VOLTS.values()):
            uno.apply(channel, int(volts * 1000))
        done = run(sys.executable, EXAMPLES / "air_pollution" / "person.py", **as_role("person", market))
    assert done.returncode == 0, done.stdout + done.stderr
    told = dict(line.rsplit(maxsplit=2)[:2] for line in done.stdout.splitlines() if line.endswith(" V"))
    assert told.keys() == VOLTS.keys()
    for gas, volts in VOLTS.items():
        assert float(told[gas]) == pytest.approx(volts, abs=0.02)

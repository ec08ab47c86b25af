"""The last message of each topic at any moment of a recording."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from bridges.foxglove import sources
from bridges.foxglove.sources import MOMENT_LIMITS, Moments
from mesh.recording import GENEROUS, open_objective
from tests.support.objectives import timed

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("count", [1, 5, MOMENT_LIMITS.points, 10 * MOMENT_LIMITS.points + 7])
@pytest.mark.parametrize("remembered", [MOMENT_LIMITS.size, 50])
def test_a_moment_is_what_a_full_reading_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, remembered: int
) -> None:
    monkeypatch.setattr(sources, "MOMENT_LIMITS", MOMENT_LIMITS._replace(size=remembered))
    chance = random.Random(count)
    path = tmp_path / "recording.mcap"
    # Many messages have the same time.
    times = sorted(chance.randrange(max(1, count // 3)) for _ in range(count))
    path.write_bytes(timed((f"/{chance.randrange(5)}", float(number), at) for number, at in enumerate(times)))
    recording = open_objective(path, GENEROUS)
    found = Moments(recording)
    for at in [chance.randrange(-1, count + 1) for _ in range(50)] + [times[0], times[-1]]:
        last = {}
        index = 0
        for message in recording.messages():
            if message.log_time_ns <= at:
                last[message.topic] = message
                index += 1
        number, shown = found.at(at)
        assert number == index
        assert {message.topic: message for message in shown} == last


def test_points_are_few(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    path.write_bytes(timed(("/x", float(number), number) for number in range(10_000)))
    found = Moments(open_objective(path, GENEROUS))
    found.at(5)
    assert len(found._points) <= MOMENT_LIMITS.points

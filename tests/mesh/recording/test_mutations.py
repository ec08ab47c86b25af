from __future__ import annotations

import random
import tracemalloc
from typing import TYPE_CHECKING

import pytest

from mesh.recording import Limits, RecordingError, open_objective
from tests.mesh.recording.mutants import FILES, mutant

if TYPE_CHECKING:
    from pathlib import Path

LIMITS = Limits(size=1 << 20, expanded=4 << 20, record=1 << 20, window=2 << 20, definitions=1 << 20)


@pytest.mark.parametrize("name", list(FILES))
def test_a_mutated_file_is_read_or_refused_within_bounded_memory(tmp_path: Path, name: str) -> None:
    dice = random.Random(name)
    path = tmp_path / "mutant"
    refused = 0
    reasons: set[str] = set()
    tracemalloc.start()
    try:
        for attempt in range(300):
            path.write_bytes(mutant(dice, FILES[name], attempt))
            try:
                sum(len(one.payload) for one in open_objective(path, LIMITS).messages())
            except RecordingError as error:
                refused += 1
                reasons.add(error.reason)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert refused > 50
    assert reasons <= {"not-a-recording", "corrupt", "expands-too-much"}
    assert peak < 12 << 20

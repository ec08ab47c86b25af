"""Hostile and mutated files: each is opened within bounds, or refused. Bombs run in a process of their own."""

from __future__ import annotations

import json
import random
import sys
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from mcap.opcode import Opcode

from mesh.recording import Limits, RecordingError, open_objective
from tests.support.commands import run
from tests.support.recording.bombs import BOMBS, one_chunk
from tests.support.recording.mutants import FILES, mutant

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[3]
MUTANTS = 40
"""Of each of the eight valid files."""
MEMORY = 256 << 20
SECONDS = 20.0
"""Of the processor, to examine a file, and again to read it when it is played. The slowest file takes 3 on an idle
machine, and took 6 on a busy one."""
REASONS = {"not-a-recording", "corrupt", "expands-too-much", "too-long", "unreadable-message", "unplayable-topic"}
OPENING = """
import json, sys, time
from pathlib import Path
from mesh.recording import preflight
for path in sorted(Path(sys.argv[1]).iterdir()):
    begin = time.process_time()
    outcome = preflight(path)
    examined = time.process_time()
    if outcome.objective is not None:
        for message in outcome.objective.messages():
            pass
    seconds = max(examined - begin, time.process_time() - examined)
    peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM:"))
    print(json.dumps([path.name, outcome.reason, outcome.detail, seconds, 1024 * int(peak)]))
"""


def opened(folder: Path) -> dict[str, tuple[str, str]]:
    """The reason and the detail for each file of the folder. Fails if one takes too much time or memory."""
    done = run(sys.executable, "-c", OPENING, folder, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    for name, _, _, seconds, peak in lines:
        assert seconds < SECONDS, f"{name} took {seconds} seconds of the processor"
        assert peak < MEMORY, f"{name} took {peak >> 20} MiB"
    return {name: (reason, detail) for name, reason, detail, *_ in lines}


@pytest.mark.parametrize("name", list(FILES))
def test_mutated_files_are_read_or_refused_within_time_and_memory(tmp_path: Path, name: str) -> None:
    dice = random.Random(name)
    for number in range(MUTANTS):
        (tmp_path / f"{number:02}").write_bytes(mutant(dice, FILES[name], number))
    outcomes = opened(tmp_path)
    assert len(outcomes) == MUTANTS
    refused = [(reason, detail) for reason, detail in outcomes.values() if reason]
    assert len(refused) >= MUTANTS // 6
    for reason, detail in refused:
        assert reason in REASONS
        assert len(detail.splitlines()) == 1


@pytest.mark.sample("bomb", "reason")
@pytest.mark.parametrize(("bomb", "reason"), BOMBS.items(), ids=lambda item: getattr(item, "__name__", ""))
def test_bombs_are_refused_within_time_and_memory(tmp_path: Path, bomb: Callable[[], bytes], reason: str) -> None:
    content = bomb()
    assert len(content) <= Limits().size
    (tmp_path / "bomb").write_bytes(content)
    del content
    found, detail = opened(tmp_path)["bomb"]
    assert found == reason
    assert bool(detail) == bool(reason)


def test_the_bomb_of_a_gigabyte_is_a_small_file() -> None:
    assert len(one_chunk()) < 70_000


def test_no_opcode_of_the_format_is_private() -> None:
    assert max(Opcode) < 0x80


LIMITS = Limits(size=1 << 20, expanded=4 << 20, record=1 << 20, window=2 << 20, definitions=1 << 20)


@pytest.mark.sample("name")
@pytest.mark.parametrize("name", list(FILES))
def test_a_mutated_file_is_read_or_refused_within_bounded_memory(tmp_path: Path, name: str) -> None:
    dice = random.Random(name)
    path = tmp_path / "mutant"
    refused = 0
    reasons: set[str] = set()
    tracemalloc.start()
    try:
        for attempt in range(100):
            path.write_bytes(mutant(dice, FILES[name], attempt))
            try:
                sum(len(one.payload) for one in open_objective(path, LIMITS).messages())
            except RecordingError as error:
                refused += 1
                reasons.add(error.reason)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert refused > 16
    assert reasons <= {"not-a-recording", "corrupt", "expands-too-much"}
    assert peak < 12 << 20

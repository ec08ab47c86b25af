from __future__ import annotations

import random
import tracemalloc
from typing import TYPE_CHECKING

import pytest
from mcap.writer import CompressionType

from mesh.recording import Limits, RecordingError, open_objective
from tests.mesh.recording.files import T0, with_messages
from tests.support.bags import Bag, Sent, string

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TIMES = [T0 + n * 7919 % 400 for n in range(400)]
SENT = [Sent("/a", string(f"message {n}"), time) for n, time in enumerate(TIMES)]
FILES = {
    "mcap zstd": with_messages(TIMES),
    "mcap lz4": with_messages(TIMES, compression=CompressionType.LZ4),
    "mcap plain, no checksums": with_messages(TIMES, use_chunking=False, enable_crcs=False),
    "mcap chunks, no checksums": with_messages(TIMES, compression=CompressionType.NONE, enable_crcs=False),
    "bag": Bag(SENT, per_chunk=40).encode(),
    "bag bz2": Bag(SENT, "bz2", per_chunk=40).encode(),
    "bag lz4": Bag(SENT, "lz4", per_chunk=40).encode(),
}
LIMITS = Limits(size=1 << 20, expanded=4 << 20, record=1 << 20, window=2 << 20, definitions=1 << 20)


def flip(dice: random.Random, content: bytearray) -> None:
    content[dice.randrange(len(content))] ^= 1 << dice.randrange(8)


def overwrite(dice: random.Random, content: bytearray) -> None:
    start = dice.randrange(len(content))
    content[start : start + 8] = dice.choice([b"\xff" * 8, bytes(8), dice.randbytes(8), b"\x7f" + b"\xff" * 7])


def cut_out(dice: random.Random, content: bytearray) -> None:
    start = dice.randrange(len(content))
    del content[start : start + dice.randrange(1, 200)]


def repeat(dice: random.Random, content: bytearray) -> None:
    start, length = dice.randrange(len(content)), dice.randrange(1, 500)
    content[start:start] = content[start : start + length]


MUTATIONS: list[Callable[[random.Random, bytearray], None]] = [flip, overwrite, cut_out, repeat]


@pytest.mark.parametrize("name", list(FILES))
def test_a_mutated_file_is_read_or_refused_within_bounded_memory(tmp_path: Path, name: str) -> None:
    dice = random.Random(name)
    path = tmp_path / "mutant"
    refused = 0
    reasons: set[str] = set()
    tracemalloc.start()
    try:
        for attempt in range(300):
            content = bytearray(FILES[name])
            for _ in range(dice.randrange(1, 4)):
                MUTATIONS[attempt % len(MUTATIONS)](dice, content)
            path.write_bytes(content)
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

"""Valid recordings of eight kinds, and random mutations of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcap.writer import CompressionType

from tests.support.bags import Bag, BagMessage, string
from tests.support.recording.files import T0, with_messages
from tests.support.rosbag2 import database_bytes

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

TIMES = [T0 + n * 7919 % 400 for n in range(400)]
SENT = [BagMessage("/a", string(f"message {n}"), time) for n, time in enumerate(TIMES)]
FILES = {
    "mcap zstd": with_messages(TIMES),
    "mcap lz4": with_messages(TIMES, compression=CompressionType.LZ4),
    "mcap plain, no checksums": with_messages(TIMES, use_chunking=False, enable_crcs=False),
    "mcap chunks, no checksums": with_messages(TIMES, compression=CompressionType.NONE, enable_crcs=False),
    "bag": Bag(SENT, per_chunk=40).encode(),
    "bag bz2": Bag(SENT, "bz2", per_chunk=40).encode(),
    "bag lz4": Bag(SENT, "lz4", per_chunk=40).encode(),
    "rosbag2 sqlite3": database_bytes(rows=[(1, time, string(f"message {n}")) for n, time in enumerate(TIMES)]),
}


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


def mutant(dice: random.Random, content: bytes, number: int) -> bytes:
    """The content with one to three mutations of one kind."""
    mutated = bytearray(content)
    for _ in range(dice.randrange(1, 4)):
        MUTATIONS[number % len(MUTATIONS)](dice, mutated)
    return bytes(mutated)

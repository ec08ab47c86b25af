"""How much of a file of unknown origin is taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds on a recording that is opened. Sizes are in bytes.

    They bound the memory, too: a reader holds `window` of a file at most, and besides no more than `record`. With the
    defaults, whatever a file is made of, looking at all of it takes less than 256 MiB and 5 seconds of one core.
    """

    size: int = 256 << 20
    """The file."""
    expanded: int = 1 << 30
    """All its chunks, decompressed."""
    bz2: int = 32 << 20
    """Those of them that are bz2, which takes twenty times as long to expand as the others."""
    record: int = 32 << 20
    """One record: a chunk, before and after decompression, or a message."""
    window: int = 96 << 20
    """What must be in memory at once to give messages that are out of order by their time."""
    definitions: int = 4 << 20
    """All its schemas, channels and metadata, repetitions left out. As objects they take twenty times as much."""
    channels: int = 4096
    messages: int = 500_000
    """Messages, and records of other kinds beside them in chunks: 500 seconds at 1 kHz."""
    blocks: int = 50_000
    """Chunks, stretches of messages outside chunks, and attachments."""
    json: int = 32 << 20
    """All its JSON messages: no other bytes take as long to read (`preflight` alone asks: `expands-too-much`)."""
    duration_ns: int = 7 * 24 * 3600 * 10**9
    """From the first message to the last, nanoseconds (`preflight` alone asks: `too-long`)."""


GENEROUS: Final = Limits(
    size=8 << 30,
    expanded=32 << 30,
    bz2=32 << 30,
    definitions=64 << 20,
    messages=50_000_000,
    blocks=1_000_000,
)
"""What a person who asks for a file takes: more than a robot does of a stranger."""

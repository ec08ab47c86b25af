"""How much of a file of unknown origin is taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds on a recording that is opened. Sizes are in bytes.

    They bound the memory, too: a reader holds `window` of a file at most, and besides no more than `record`.
    """

    size: int = 256 << 20
    """The file."""
    expanded: int = 1 << 30
    """All its chunks, decompressed."""
    record: int = 32 << 20
    """One record: a chunk, before and after decompression, or a message."""
    window: int = 96 << 20
    """What must be in memory at once to give messages that are out of order by their time."""
    definitions: int = 16 << 20
    """All its schemas, channels and metadata."""
    channels: int = 4096
    messages: int = 1_000_000
    """And as many records of other kinds: reading as many takes two to four seconds."""
    duration_ns: int = 7 * 24 * 3600 * 10**9
    """From the first message to the last, nanoseconds (`preflight` alone asks: `too-long`)."""


GENEROUS: Final = Limits(size=8 << 30, expanded=32 << 30, messages=50_000_000)
"""What a person who asks for a file takes: more than a robot does of a stranger."""

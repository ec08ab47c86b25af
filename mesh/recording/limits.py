"""How much of a file of unknown origin is taken."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds on a recording that is opened. Sizes are in bytes.

    They bound the memory, too: a reader holds `window` of a file at most, and besides no more than `record`.
    """

    size: int = 256 << 20
    """The file."""
    expanded: int = 1 << 30
    """All its chunks, decompressed."""
    record: int = 64 << 20
    """One record: a chunk, before and after decompression, or a message."""
    window: int = 256 << 20
    """What must be in memory at once to give messages that are out of order by their time."""
    definitions: int = 16 << 20
    """All its schemas, channels and metadata."""
    channels: int = 4096
    messages: int = 10_000_000
    duration_ns: int = 7 * 24 * 3600 * 10**9
    """From the first message to the last, nanoseconds (`preflight` alone asks: `too-long`)."""

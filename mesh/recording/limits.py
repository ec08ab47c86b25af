"""Limits on recordings of unknown origin, and the checks that enforce them."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.recording.errors import RecordingTooLarge

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from mesh.recording.source import RecordingBlock, Segment


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits for a recording that is opened. Sizes are in bytes.

    They also bound the memory: a reader holds at most `window` bytes of a file, and `record` bytes more. With the
    defaults, checking any file takes less than 256 MiB and 5 seconds of one idle core.
    """

    size: int = 256 << 20
    """The file."""
    expanded: int = 1 << 30
    """All its chunks, decompressed."""
    bz2: int = 32 << 20
    """Those compressed with bz2, which take twenty times as long to expand as others."""
    record: int = 32 << 20
    """One record: a chunk, before and after decompression, or a message."""
    window: int = 96 << 20
    """What must be in memory at once to sort messages by time."""
    definitions: int = 4 << 20
    """All its schemas, channels and metadata without repetitions. As objects they take twenty times as much."""
    channels: int = 4096
    messages: int = 500_000
    """Messages and other records in chunks: 500 seconds at 1 kHz."""
    blocks: int = 50_000
    """Chunks, runs of messages outside chunks, and attachments."""
    json: int = 32 << 20
    """All its JSON messages, which take longer to decode than any others. Checked by `preflight` only."""
    duration_ns: int = 7 * 24 * 3600 * 10**9
    """From the first message to the last, nanoseconds. Checked by `preflight` only."""


GENEROUS: Final = Limits(
    size=8 << 30,
    expanded=32 << 30,
    bz2=32 << 30,
    definitions=64 << 20,
    messages=50_000_000,
    blocks=1_000_000,
)
"""For a file that a person asked for: more than a robot accepts from a stranger."""


@dataclass
class ExpansionCounter:
    """Adds up how many bytes the blocks of a file will expand to, before any is expanded."""

    path: Path
    limits: Limits
    size: int = 0
    bz2: int = 0

    def add(self, block: RecordingBlock) -> None:
        """Count a block. Raises `RecordingTooLarge`."""
        self.size += block.size
        if self.size > self.limits.expanded:
            why = f"its chunks expand to more than the {self.limits.expanded} bytes allowed"
            raise RecordingTooLarge(self.path, why, limit="expanded")
        self.bz2 += block.size if block.compression == "bz2" else 0
        if self.bz2 > self.limits.bz2:
            why = f"its bz2 chunks expand to more than the {self.limits.bz2} bytes allowed; lz4 is faster"
            raise RecordingTooLarge(self.path, why, limit="bz2")


def check_counts(path: Path, limits: Limits, *, records: int, blocks: int) -> None:
    """Raise `RecordingTooLarge` over `limits.messages` records in blocks, or over `limits.blocks` blocks."""
    if records > limits.messages:
        raise RecordingTooLarge(path, f"more than {limits.messages} messages and definitions", limit="messages")
    if blocks > limits.blocks:
        raise RecordingTooLarge(path, f"more than {limits.blocks} blocks of messages and attachments", limit="blocks")


def check_definitions(path: Path, limits: Limits, *, channels: int, size: int) -> None:
    """Raise `RecordingTooLarge` over `limits.channels` channels, or over `limits.definitions` bytes."""
    if size > limits.definitions:
        raise RecordingTooLarge(path, f"more than {limits.definitions} bytes of definitions", limit="definitions")
    if channels > limits.channels:
        raise RecordingTooLarge(path, f"more than {limits.channels} channels", limit="channels")


def check_window(path: Path, segments: Iterable[Segment], limits: Limits) -> None:
    """Raise `RecordingTooLarge` if sorting the messages by time would take more memory than `limits.window`."""
    open_segments: list[tuple[int, int]] = []
    held = 0
    for segment in sorted(segments, key=lambda segment: segment.start):
        while open_segments and open_segments[0][0] < segment.start:
            held -= heapq.heappop(open_segments)[1]
        heapq.heappush(open_segments, (segment.end, segment.cost))
        held += segment.cost
        if held > limits.window:
            why = f"its messages are out of order: blocks of {held} bytes overlap in time"
            raise RecordingTooLarge(path, why, limit="window")

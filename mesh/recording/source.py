"""What MCAP files and bags have in common: channels, and segments of messages that are read one at a time."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording.compression import expand
from mesh.recording.errors import CorruptRecording, RecordingTooLarge

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path
    from typing import TypeAlias

    from mesh.recording.limits import Limits
    from schemas.payloads import PayloadType

    Look: TypeAlias = Callable[["Channel", bytes], None]
    """Is shown every message of a file, on its channel, as they lie there, while the file is checked."""

_RECORD_COST: Final = 256
"""Bytes of memory that a message takes besides its payload while its segment is being sorted."""
_SEGMENT_COST: Final = 2048
"""Bytes of memory that a segment takes besides its data while its messages are being given."""


class Record(NamedTuple):
    """A message as a file holds it. Times are in nanoseconds."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    payload: bytes


@dataclass(frozen=True)
class Channel:
    """A topic of a file, and how its payloads are to be read. `metadata` is the channel's own, of MCAP or a bag."""

    topic: str
    type: PayloadType
    metadata: Mapping[str, str] = field(default_factory=dict)


class Attachment(NamedTuple):
    """A file within a file: `size` bytes from `offset`. Times are in nanoseconds."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    offset: int
    size: int


class RecordingStatistics(NamedTuple):
    """What an MCAP file says at its end about itself. `by_channel` has the messages of each channel's number."""

    messages: int
    channels: int
    attachments: int
    chunks: int
    start: int
    end: int
    by_channel: Mapping[int, int]


@dataclass(frozen=True, slots=True)
class Block:
    """Where messages are in a file: `stored` bytes from `offset`, which expand to `size`."""

    offset: int
    stored: int
    size: int
    compression: str = ""


@dataclass(frozen=True, slots=True)
class Segment:
    """A block whose messages were read once. `sorted` tells whether they are in the order of their log time."""

    number: int
    block: Block
    count: int
    start: int
    end: int
    sorted: bool

    @property
    def cost(self) -> int:
        """Bytes of memory that it takes while its messages are being given."""
        return self.block.size + _SEGMENT_COST + (0 if self.sorted else self.count * _RECORD_COST)


@dataclass(frozen=True)
class Source:
    """A checked file: what is in it, and how the messages of one of its blocks are read.

    `records` takes the decompressed bytes of a block and may raise `CorruptRecording`.
    """

    path: Path
    format: str
    size: int
    channels: Mapping[int, Channel]
    segments: tuple[Segment, ...]
    metadata: Mapping[str, Mapping[str, str]]
    records: Callable[[bytes], Iterator[Record]]
    attachments: tuple[Attachment, ...] = ()
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    """Blocks of messages without a checksum."""

    def in_file_order(self) -> Iterator[Record]:
        """All messages as they lie in the file."""
        with self.path.open("rb") as file:
            for segment in self.segments:
                yield from self.records(load(self.path, file, segment.block))

    def in_time_order(self, *, skip: int = 0) -> Iterator[Record]:
        """All messages but the first `skip` by their log time; those of one time as they lie in the file."""
        with self.path.open("rb") as file:
            waiting = sorted(self.segments, key=lambda segment: (segment.start, segment.number))
            position, skip = _skip_whole(waiting, skip)
            merged = self._merge(file, waiting[position:])
            for _ in zip(range(skip), merged, strict=False):
                pass
            yield from merged

    def _merge(self, file: BinaryIO, waiting: list[Segment]) -> Iterator[Record]:
        """Merge segments, each held in memory only while its time span lasts. `waiting` is sorted by start."""
        following = iter(waiting)
        upcoming = next(following, None)
        heap: list[tuple[int, int, Record, Iterator[Record]]] = []
        while heap or upcoming:
            while upcoming and (not heap or upcoming.start <= heap[0][0]):
                self._open(file, upcoming, heap)
                upcoming = next(following, None)
            _, number, record, rest = heap[0]
            yield record
            after = next(rest, None)
            if after is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (after.log_time, number, after, rest))

    def _open(self, file: BinaryIO, segment: Segment, heap: list[tuple[int, int, Record, Iterator[Record]]]) -> None:
        records = self.records(load(self.path, file, segment.block))
        if not segment.sorted:
            records = iter(sorted(records, key=lambda record: record.log_time))
        first = next(records, None)
        if first is None:
            raise CorruptRecording(self.path, "it changed while it was being read")
        heapq.heappush(heap, (first.log_time, segment.number, first, records))


@dataclass
class Expanding:
    """What the blocks of a file will expand to, in bytes, of which nothing was expanded yet."""

    path: Path
    limits: Limits
    size: int = 0
    bz2: int = 0

    def add(self, block: Block) -> None:
        """Count a block. Raises `RecordingTooLarge`."""
        self.size += block.size
        if self.size > self.limits.expanded:
            raise RecordingTooLarge(
                self.path, f"its chunks expand to more than the {self.limits.expanded} bytes allowed"
            )
        self.bz2 += block.size if block.compression == "bz2" else 0
        if self.bz2 > self.limits.bz2:
            raise RecordingTooLarge(
                self.path, f"its bz2 chunks expand to more than the {self.limits.bz2} bytes allowed; lz4 is faster"
            )


def load(path: Path, file: BinaryIO, block: Block) -> bytes:
    """The decompressed bytes of a block. Raises `CorruptRecording`."""
    file.seek(block.offset)
    data = file.read(block.stored)
    if len(data) != block.stored:
        raise CorruptRecording(path, "it is cut off in a chunk")
    return expand(path, data, compression=block.compression, size=block.size)


def survey(path: Path, number: int, block: Block, *, records: Iterable[Record]) -> Segment | None:
    """Read all messages of a block once; None if there are none."""
    count, start, end, last, in_order = 0, 0, 0, -1, True
    for record in records:
        time = record.log_time
        start = time if count == 0 else min(start, time)
        end = max(end, time)
        in_order = in_order and time >= last
        last = time
        count += 1
    return Segment(number, block, count, start, end, in_order) if count else None


def check_counts(path: Path, limits: Limits, *, records: int, blocks: int) -> None:
    """Raise `RecordingTooLarge` over `limits.messages` records in blocks, or over `limits.blocks` blocks."""
    if records > limits.messages:
        raise RecordingTooLarge(path, f"more than {limits.messages} messages and what describes them")
    if blocks > limits.blocks:
        raise RecordingTooLarge(path, f"its messages and attachments lie in more than {limits.blocks} places")


def check_definitions(path: Path, limits: Limits, *, channels: int, size: int) -> None:
    """Raise `RecordingTooLarge` over `limits.channels` channels, or over `limits.definitions` bytes."""
    if size > limits.definitions or channels > limits.channels:
        raise RecordingTooLarge(path, f"{channels} channels, {size} bytes of definitions")


def check_window(path: Path, segments: Iterable[Segment], limits: Limits) -> None:
    """Raise `RecordingTooLarge` if giving the messages in order would take more memory than allowed."""
    open_segments: list[tuple[int, int]] = []
    held = 0
    for segment in sorted(segments, key=lambda segment: segment.start):
        while open_segments and open_segments[0][0] < segment.start:
            held -= heapq.heappop(open_segments)[1]
        heapq.heappush(open_segments, (segment.end, segment.cost))
        held += segment.cost
        if held > limits.window:
            raise RecordingTooLarge(path, f"its messages are so out of order that {held} bytes of it overlap in time")


def _skip_whole(waiting: list[Segment], skip: int) -> tuple[int, int]:
    """How many segments (sorted by start) need not be read to skip that many messages, and how many remain to skip."""
    position = 0
    for segment, following in pairwise(waiting):
        if segment.count > skip or segment.end >= following.start:
            break
        position, skip = position + 1, skip - segment.count
    return position, skip

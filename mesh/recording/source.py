"""A checked recording: its channels, and its messages in blocks that are read one at a time."""

from __future__ import annotations

import heapq
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from mesh.recording.decoding import expand
from mesh.recording.errors import CorruptRecording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from contextlib import AbstractContextManager
    from pathlib import Path
    from typing import TypeAlias

    from schemas.payloads import PayloadType

    OnMessage: TypeAlias = Callable[["RecordingChannel", bytes], None]
    """Is called with the channel and payload of each message, in file order, while the file is checked."""
    BlockReader: TypeAlias = Callable[["RecordingBlock"], Iterator["RecordedMessage"]]
    """Returns the messages of a block. May raise `CorruptRecording`."""

_RECORD_COST: Final = 256
"""Bytes of memory that a message takes besides its payload while its segment is being sorted."""
_SEGMENT_COST: Final = 2048
"""Bytes of memory that a segment takes besides its data while it is being read."""


class RecordedMessage(NamedTuple):
    """A message as it is in a file. Times are in nanoseconds."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    payload: bytes


@dataclass(frozen=True)
class RecordingChannel:
    """A channel of a file: a topic, the type of its payloads, and the channel's own metadata."""

    topic: str
    type: PayloadType
    metadata: Mapping[str, str] = field(default_factory=dict)


class Attachment(NamedTuple):
    """A file inside the file: `size` bytes at `offset`. Times are in nanoseconds."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    offset: int
    size: int


class RecordingStatistics(NamedTuple):
    """The statistics at the end of an MCAP file. `by_channel` is the number of messages by channel number."""

    messages: int
    channels: int
    attachments: int
    chunks: int
    start: int
    end: int
    by_channel: Mapping[int, int]


@dataclass(frozen=True, slots=True)
class RecordingBlock:
    """Where a block of messages is in a file: `stored` bytes at `offset`, which expand to `size`.

    In a database `offset` is the first row, and `stored` the last one.
    """

    offset: int
    stored: int
    size: int
    compression: str = ""


@dataclass(frozen=True, slots=True)
class Segment:
    """A block that was surveyed: its number of messages, first and last log time, and whether they are in order."""

    number: int
    block: RecordingBlock
    count: int
    start: int
    end: int
    sorted: bool

    @property
    def cost(self) -> int:
        """Bytes of memory that it takes while it is being read."""
        return self.block.size + _SEGMENT_COST + (0 if self.sorted else self.count * _RECORD_COST)


@dataclass(frozen=True)
class RecordingSource:
    """A checked file: its content, and how to read the messages of its blocks: `reading` opens the file for that."""

    path: Path
    format: str
    size: int
    channels: Mapping[int, RecordingChannel]
    segments: tuple[Segment, ...]
    metadata: Mapping[str, Mapping[str, str]]
    reading: Callable[[], AbstractContextManager[BlockReader]]
    attachments: tuple[Attachment, ...] = ()
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    """Blocks of messages without a checksum."""
    repeated: frozenset[str] = frozenset()
    """Names of metadata records that the file has more than once; `metadata` has the last one."""

    def in_file_order(self) -> Iterator[RecordedMessage]:
        """All messages in file order."""
        with self.reading() as read:
            for segment in self.segments:
                yield from read(segment.block)

    def in_time_order(self, *, skip: int = 0) -> Iterator[RecordedMessage]:
        """All messages by log time, without the first `skip`; those of equal time in file order."""
        with self.reading() as read:
            waiting = sorted(self.segments, key=lambda segment: (segment.start, segment.number))
            position, skip = _skip_whole(waiting, skip)
            merged = self._merge(read, waiting[position:])
            for _ in zip(range(skip), merged, strict=False):
                pass
            yield from merged

    def _merge(self, read: BlockReader, waiting: list[Segment]) -> Iterator[RecordedMessage]:
        """Merge segments by time, holding each in memory only during its time span. `waiting` is sorted by start."""
        following = iter(waiting)
        upcoming = next(following, None)
        heap: list[tuple[int, int, RecordedMessage, Iterator[RecordedMessage]]] = []
        while heap or upcoming:
            while upcoming and (not heap or upcoming.start <= heap[0][0]):
                self._open(read, upcoming, heap)
                upcoming = next(following, None)
            _, number, record, rest = heap[0]
            yield record
            after = next(rest, None)
            if after is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (after.log_time, number, after, rest))

    def _open(
        self,
        read: BlockReader,
        segment: Segment,
        heap: list[tuple[int, int, RecordedMessage, Iterator[RecordedMessage]]],
    ) -> None:
        records = read(segment.block)
        if not segment.sorted:
            records = iter(sorted(records, key=lambda record: record.log_time))
        first = next(records, None)
        if first is None:
            raise CorruptRecording(self.path, "the file changed while it was being read")
        heapq.heappush(heap, (first.log_time, segment.number, first, records))


@contextmanager
def reading_file(path: Path, read_messages: Callable[[bytes], Iterator[RecordedMessage]]) -> Iterator[BlockReader]:
    """Open a file of chunks. `read_messages` takes the decompressed bytes of a block."""
    with path.open("rb") as file:
        yield lambda block: read_messages(load_block(path, file, block))


def load_block(path: Path, file: BinaryIO, block: RecordingBlock) -> bytes:
    """The decompressed bytes of a block. Raises `CorruptRecording`."""
    file.seek(block.offset)
    data = file.read(block.stored)
    if len(data) != block.stored:
        raise CorruptRecording(path, "it is cut off in a chunk")
    return expand(path, data, compression=block.compression, size=block.size)


def survey_block(
    path: Path, number: int, block: RecordingBlock, *, records: Iterable[RecordedMessage]
) -> Segment | None:
    """Read all messages of a block once, and return its segment; None if it has no messages."""
    count, start, end, last, in_order = 0, 0, 0, -1, True
    for record in records:
        time = record.log_time
        start = time if count == 0 else min(start, time)
        end = max(end, time)
        in_order = in_order and time >= last
        last = time
        count += 1
    return Segment(number, block, count, start, end, in_order) if count else None


def _skip_whole(waiting: list[Segment], skip: int) -> tuple[int, int]:
    """How many segments (sorted by start) can be skipped unread, and how many messages remain to skip after them."""
    position = 0
    for segment, following in pairwise(waiting):
        if segment.count > skip or segment.end >= following.start:
            break
        position, skip = position + 1, skip - segment.count
    return position, skip

"""A checked recording of unknown origin: its channels, and its messages in blocks that are read one at a time.

What the readers of all formats share: the errors, the limits and the checks that enforce them, decoding bytes that may
be anything (no field is read past the end, no chunk expands beyond its stated size), and reading in order of time.
A `RecordingError` has a machine-readable `reason`, as in `preflight`.
"""

from __future__ import annotations

import bz2
import heapq
import io
from abc import ABC, abstractmethod
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from struct import Struct
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from mesh.errors import AiraError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from contextlib import AbstractContextManager
    from pathlib import Path
    from typing import TypeAlias

    from mesh.settings import ContentSettings
    from schemas.payloads import PayloadType

    OnMessage: TypeAlias = Callable[["RecordingChannel", bytes], None]
    """Is called with the channel and payload of each message, in file order, while the file is checked."""
    OnFault: TypeAlias = Callable[["CorruptRecording"], None]
    """Is called with what is wrong with a record, which is then left out."""
    BlockReader: TypeAlias = Callable[["RecordingBlock"], Iterator["RecordedMessage"]]
    """Returns the messages of a block. May raise `CorruptRecording`."""


class RecordingError(InputError, code="recording-error"):
    """A file is not usable as a recording. `reason` is machine-readable, `why` is for people.

    Over a limit (code `recording-too-large`), `limit` is the field of `Limits`.
    """

    def __init__(
        self, why: str, *, reason: str, hint: str, code: str = "", limit: str = "", path: Path | None = None
    ) -> None:
        super().__init__(why, hint=hint, code=code)
        self.path = path
        self.why = why
        self.reason = reason
        self.limit = limit

    def __str__(self) -> str:
        return self.why if self.path is None else f"{self.path.name}: {self.why}"


class NotARecording(RecordingError, code="not-a-recording"):
    """A file is neither MCAP, nor a ROS 1 bag, nor of rosbag2, or can't be read at all."""

    def __init__(self, why: str, *, path: Path | None = None) -> None:
        hint = "an objective is an MCAP file, a ROS 1 bag, or a file of rosbag2"
        super().__init__(why, reason="not-a-recording", hint=hint, path=path)


class CorruptRecording(RecordingError, code="corrupt-recording"):
    """A file begins as a recording, but is cut off or damaged."""

    def __init__(self, why: str, *, path: Path | None = None) -> None:
        hint = "record it again, or recover the readable part: `aira objective recover`"
        super().__init__(why, reason="corrupt", hint=hint, path=path)


class Unrecordable(InputError, code="unrecordable"):
    """No recording can hold this message; nothing of it was written."""


class RecordingFailed(AiraError, code="recording-failed"):
    """The disk refused the recording; what was written before can be recovered."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"can't record to {path}: {why}", hint="free space on the disk, then recover the file")
        self.path = path


@contextmanager
def about(path: Path) -> Iterator[None]:
    """A `RecordingError` inside is about the file at `path`, and names it."""
    try:
        yield
    except RecordingError as error:
        error.path = error.path or path
        raise


def recording_exists(path: Path) -> InputError:
    """The error that a recording of that name exists: none is ever overwritten."""
    return InputError(f"{path} already exists", hint="choose another name, or move it away", code="recording-exists")


_OVER: Final = {
    "size": "it has {found} bytes, more than the {most} allowed",
    "expanded": "its chunks expand to more than the {most} bytes allowed",
    "bz2": "its bz2 chunks expand to more than the {most} bytes allowed; lz4 is faster",
    "record": "a record of {found} bytes, more than the {most} allowed",
    "window": "its messages are out of order: blocks of {found} bytes overlap in time",
    "definitions": "more than {most} bytes of definitions",
    "channels": "more than {most} channels",
    "messages": "more than {most} messages and definitions",
    "blocks": "more than {most} blocks of messages and attachments",
}


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

    def check(self, **found: int) -> None:
        """Raise `RecordingError` if one of these amounts is over its limit."""
        for limit, amount in found.items():
            if amount > (most := getattr(self, limit)):
                why = _OVER[limit].format(found=amount, most=most)
                reason = "too-large" if limit == "size" else "expands-too-much"
                hint = "raise the limits, or use a smaller recording"
                raise RecordingError(why, reason=reason, hint=hint, code="recording-too-large", limit=limit)

    @classmethod
    def of(cls, settings: ContentSettings) -> Limits:
        """How large an objective a robot with these settings accepts."""
        return cls(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)


GENEROUS: Final = Limits(
    size=8 << 30, expanded=32 << 30, bz2=32 << 30, definitions=64 << 20, messages=50_000_000, blocks=1_000_000
)
"""For a file that a person asked for: more than a robot accepts from a stranger."""


@dataclass
class ExpansionCounter:
    """Adds up how many bytes the blocks of a file will expand to, before any is expanded."""

    limits: Limits
    size: int = 0
    bz2: int = 0

    def add(self, block: RecordingBlock) -> None:
        """Count a block. Raises `RecordingError` over a limit."""
        self.size += block.size
        self.bz2 += block.size if block.compression == "bz2" else 0
        self.limits.check(expanded=self.size, bz2=self.bz2)


def check_window(segments: Iterable[Segment], limits: Limits) -> None:
    """Raise `RecordingError` if sorting the messages by time would take more memory than `limits.window`."""
    open_segments: list[tuple[int, int]] = []
    held = 0
    for segment in sorted(segments, key=lambda segment: segment.start):
        while open_segments and open_segments[0][0] < segment.start:
            held -= heapq.heappop(open_segments)[1]
        heapq.heappush(open_segments, (segment.end, segment.cost))
        held += segment.cost
        limits.check(window=held)


_U16: Final = Struct("<H")
_U32: Final = Struct("<I")
_U64: Final = Struct("<Q")
_ZSTD_WINDOW: Final = 128 << 20
"""Bytes of memory that a zstd frame may ask for: the most that its ordinary levels use."""

RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are read as one block."""


class Cursor:
    """Reads fields of bytes one after the other, little-endian as in MCAP and bags.

    All calls raise `CorruptRecording` if the bytes end too early.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._position

    def take(self, length: int) -> bytes:
        """The next `length` bytes."""
        if length > self.left:
            raise CorruptRecording(f"a field of {length} bytes, but only {self.left} are left")
        taken = self._data[self._position : self._position + length]
        self._position += length
        return taken

    def u16(self) -> int:
        """The next two bytes as a number."""
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        """The next four bytes as a number."""
        return int(_U32.unpack(self.take(4))[0])

    def u64(self) -> int:
        """The next eight bytes as a number."""
        return int(_U64.unpack(self.take(8))[0])

    def data(self) -> bytes:
        """Bytes after their length, a u32."""
        return self.take(self.u32())

    def text(self) -> str:
        """A UTF-8 text after its length, a u32."""
        return text_of(self.data())

    def pairs(self) -> dict[str, str]:
        """A map of texts after its length, a u32."""
        inner = Cursor(self.data())
        found = {}
        while inner.left:
            key = inner.text()
            found[key] = inner.text()
        return found


def text_of(data: bytes) -> str:
    """`data` as UTF-8. Raises `CorruptRecording`."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise CorruptRecording(f"{data[:40]!r} is not UTF-8") from None


def expand(data: bytes, *, compression: str, size: int) -> bytes:
    """The `size` bytes that a chunk contains; `compression` is its name in MCAP and bags.

    Never produces more than `size` + 1 bytes. Raises `CorruptRecording`.
    """
    try:
        expanded = _expand(data, compression, size + 1)
    except (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError, MemoryError) as error:
        raise CorruptRecording(f"a {compression} chunk can't be decompressed: {error}") from None
    if len(expanded) != size:
        raise CorruptRecording(f"a chunk states a size of {size} bytes, and has another")
    return expanded


def expand_damaged(data: bytes, *, compression: str, most: int) -> bytes:
    """What can be decompressed of a chunk that is cut or damaged, at most `most` bytes; nothing if nothing can."""
    match compression:
        case "" | "none":
            return data[:most]
        case "zstd":
            decompress = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW).decompressobj().decompress
        case "lz4":
            decompress = lz4.frame.LZ4FrameDecompressor().decompress
        case "bz2":
            decompress = bz2.BZ2Decompressor().decompress
        case _:
            return b""
    expanded = bytearray()
    with suppress(OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError, MemoryError):
        piece = 256  # an error only takes what is in the same one
        for begin in range(0, len(data), piece):
            expanded += decompress(data[begin : begin + piece])
            if len(expanded) >= most:
                break
    return bytes(expanded[:most])


def _expand(data: bytes, compression: str, most: int) -> bytes:
    match compression:
        case "" | "none":
            return data
        case "zstd":
            reader = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW).stream_reader(io.BytesIO(data))
            return bytes(reader.read(most))
        case "lz4":
            frame = lz4.frame.LZ4FrameDecompressor()
            return _ended(frame.decompress(data, max_length=most), frame.eof)
        case "bz2":
            stream = bz2.BZ2Decompressor()
            return _ended(stream.decompress(data, max_length=most), stream.eof)
        case _:
            raise ValueError("unknown compression")


def _ended(expanded: bytes, complete: bool) -> bytes:
    """The decompressed bytes. Raises `ValueError` if the input was incomplete (its checksum is then unchecked)."""
    if not complete:
        raise ValueError("it is incomplete")
    return expanded


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
    metadata: int = 0


@dataclass(frozen=True, slots=True)
class RecordingBlock:
    """Where a block of messages is in a file: `stored` bytes at `offset`, which expand to `size`.

    In a database `offset` is the first row, and `stored` the last one. `whole` is set if the block is damaged: only so
    many of its expanded bytes, from its beginning, are whole records.
    """

    offset: int
    stored: int
    size: int
    compression: str = ""
    whole: int | None = None


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
        """Bytes of memory that it takes while it is being read: 2,048 besides its data, and 256 for each message
        besides its payload if it has to be sorted."""
        return self.block.size + 2048 + (0 if self.sorted else self.count * 256)


@dataclass(frozen=True)
class RecordingSource:
    """A checked file: its content, and how to read the messages of its blocks: `reading` opens the file for that."""

    path: Path
    format: str
    size: int
    channels: Mapping[int, RecordingChannel]
    segments: tuple[Segment, ...]
    metadata_records: tuple[tuple[str, Mapping[str, str]], ...]
    reading: Callable[[], AbstractContextManager[BlockReader]]
    attachments: tuple[Attachment, ...] = ()
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    """Blocks of messages without a checksum."""

    @property
    def metadata(self) -> dict[str, Mapping[str, str]]:
        """The metadata records by name, the last one of each."""
        return dict(self.metadata_records)

    @property
    def repeated(self) -> frozenset[str]:
        """Names of metadata records that the file has more than once."""
        names = Counter(name for name, _ in self.metadata_records)
        return frozenset(name for name, times in names.items() if times > 1)

    def in_file_order(self) -> Iterator[RecordedMessage]:
        """All messages in file order."""
        with about(self.path), self.reading() as read:
            for segment in self.segments:
                yield from read(segment.block)

    def in_time_order(self, *, skip: int = 0) -> Iterator[RecordedMessage]:
        """All messages by log time, without the first `skip`; those of equal time in file order."""
        with about(self.path), self.reading() as read:
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
            raise CorruptRecording("the file changed while it was being read")
        heapq.heappush(heap, (first.log_time, segment.number, first, records))


@contextmanager
def _reading_file(path: Path, read_messages: Callable[[bytes], Iterator[RecordedMessage]]) -> Iterator[BlockReader]:
    """Open a file of chunks. `read_messages` takes the decompressed bytes of a block."""
    with path.open("rb") as file:
        yield lambda block: read_messages(load_block(file, block))


def load_block(file: BinaryIO, block: RecordingBlock) -> bytes:
    """The decompressed bytes of a block. Raises `CorruptRecording`."""
    file.seek(block.offset)
    data = file.read(block.stored)
    if len(data) != block.stored:
        raise CorruptRecording("it is cut off in a chunk")
    if block.whole is not None:
        return expand_damaged(data, compression=block.compression, most=block.whole)
    return expand(data, compression=block.compression, size=block.size)


@dataclass
class ChunkReader(ABC):
    """Reads a file of chunks from its beginning, and holds what it has found so far.

    `on_fault` is called with what is wrong with a record in a chunk, which is then left out. Without it, that is an
    error.
    """

    format: ClassVar[str]

    path: Path
    file: BinaryIO
    size: int
    limits: Limits
    on_message: OnMessage | None = None
    on_fault: OnFault | None = None
    channels: dict[int, RecordingChannel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    _defined: int = 0
    _blocks: int = 0
    _records: int = 0

    @staticmethod
    @abstractmethod
    def records_in(data: bytes) -> Iterator[Any]:
        """The records in the data of a chunk."""

    @staticmethod
    @abstractmethod
    def message_of(record: Any, data: bytes) -> RecordedMessage | None:
        """The message of a record in the data of a chunk; None if it is something else."""

    @abstractmethod
    def _define(self, record: Any, data: bytes) -> None:
        """Read a record in the data of a chunk that is no message."""

    def source(self) -> RecordingSource:
        """The file, as far as it was read."""
        read_messages = partial(_messages_in, type(self), None if self.on_fault is None else self.channels)
        return RecordingSource(
            self.path,
            self.format,
            self.size,
            self.channels,
            tuple(self.segments),
            tuple(self.metadata),
            partial(_reading_file, self.path, read_messages),
            tuple(self.attachments),
            self.statistics,
            self.unchecked,
        )

    def _read_block(self, block: RecordingBlock, data: bytes) -> None:
        """Check and count the messages in the `data` of a block; only its position is kept."""
        segment = survey_block(self._blocks, block, records=self._messages(data))
        self._blocks += 1
        self._check_counts()
        if segment is not None:
            self.segments.append(segment)

    def _read_beginning(self, block: RecordingBlock, data: bytes) -> None:
        """Read the whole records at the beginning of a block, as far as it can be expanded to `data`."""
        whole = 0
        with suppress(CorruptRecording):
            for record in self.records_in(data):
                whole = record.offset + record.length
        self._read_block(replace(block, size=whole, whole=whole), data[:whole])

    def _messages(self, data: bytes) -> Iterator[RecordedMessage]:
        on_message, most = self.on_message, self.limits.messages
        for record in self.records_in(data):
            self._records += 1
            if self._records > most:
                self._check_counts()
            try:
                if (message := self.message_of(record, data)) is None:
                    self._define(record, data)
                    continue
                if (channel := self.channels.get(message.channel)) is None:
                    raise CorruptRecording(f"a message on the undefined channel {message.channel}")
            except CorruptRecording as error:
                if self.on_fault is None:
                    raise
                self.on_fault(error)
                continue
            if on_message is not None:
                on_message(channel, message.payload)
            yield message

    def _count(self, size: int, *, channels: int = 0) -> None:
        """Count `size` bytes of definitions, and `channels` that follow."""
        self._defined += size
        self.limits.check(definitions=self._defined, channels=len(self.channels) + channels)

    def _check_counts(self) -> None:
        self.limits.check(messages=self._records, blocks=self._blocks)


def _messages_in(
    reader: type[ChunkReader], channels: Mapping[int, RecordingChannel] | None, data: bytes
) -> Iterator[RecordedMessage]:
    """The messages in the data of a chunk; with `channels`, those that are whole and on one of these."""
    for record in reader.records_in(data):
        try:
            message = reader.message_of(record, data)
        except CorruptRecording:
            if channels is None:
                raise
            continue
        if message is not None and (channels is None or message.channel in channels):
            yield message


def survey_block(number: int, block: RecordingBlock, *, records: Iterable[RecordedMessage]) -> Segment | None:
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

"""Reading MCAP files of unknown origin: everything is checked before anything is believed.

A file is read twice: by the heads of its records, so that what is too large is refused before any of it is expanded;
and then whole, chunk by chunk. The index at its end is not used, since it may say anything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, BinaryIO, Final, TypeVar

from mcap.opcode import Opcode

from mesh.recording.cursor import Cursor
from mesh.recording.errors import CorruptRecording, RecordingTooLarge
from mesh.recording.mcap_records import (
    Frame,
    attachment_of,
    channel_of,
    check_crc,
    check_record_size,
    check_stretch,
    chunk_head,
    content,
    entries,
    frames,
    metadata_of,
    record_of,
    schema_of,
    statistics_of,
)
from mesh.recording.source import (
    Attachment,
    Block,
    Channel,
    Record,
    Segment,
    Source,
    Statistics,
    check_window,
    load,
    survey,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.recording.limits import Limits

T = TypeVar("T")

_RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are taken as one block."""
_PREFIX: Final = 9
_DEFINITIONS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA})
_PRIVATE: Final = 0x80
"""The opcodes from here on are anybody's own."""


def open_mcap(path: Path, size: int, limits: Limits) -> Source:
    """Check the whole of an MCAP file of `size` bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is no MCAP file at all.
    """
    with path.open("rb") as file:
        reading = Reading(path, file, limits)
        reading.statistics, checked = _check_outline(path, file, size, limits)
        for frame in _runs(frames(path, file, size)):
            if frame.opcode == Opcode.DATA_END:
                break
            reading.take(frame)
    check_window(path, reading.segments, limits)
    if checked:
        reading.unchecked = 0
    return reading.source(size)


def records_in(path: Path, data: bytes) -> Iterator[Record]:
    """The messages in the decompressed data of a chunk."""
    for frame in entries(path, data):
        if frame.opcode == Opcode.MESSAGE:
            yield record_of(path, data, frame)


@dataclass
class Reading:
    """What was found in a file so far, record by record from its beginning."""

    path: Path
    file: BinaryIO
    limits: Limits
    channels: dict[int, Channel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: int = 0
    attachments: list[Attachment] = field(default_factory=list)
    statistics: Statistics | None = None
    unchecked: int = 0
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _defined: int = 0
    _blocks: int = 0
    _others: int = 0

    def source(self, size: int) -> Source:
        """The file, as far as it was read."""
        records = partial(records_in, self.path)
        return Source(
            self.path,
            "mcap",
            size,
            self.channels,
            tuple(self.segments),
            self.metadata,
            records,
            tuple(self.attachments),
            self.statistics,
            self.unchecked,
        )

    def take(self, frame: Frame) -> None:
        """Read one record of the file. Messages are checked and counted, and their places kept."""
        match frame.opcode:
            case Opcode.CHUNK:
                head = chunk_head(self.path, self.file, frame, limits=self.limits)
                data = load(self.path, self.file, head.block)
                check_crc(self.path, data, head.crc)
                self.unchecked += not head.crc
                self._take_block(head.block, data)
            case Opcode.MESSAGE:
                block = Block(frame.offset - _PREFIX, frame.length + _PREFIX, frame.length + _PREFIX)
                check_record_size(self.path, block.size, self.limits)
                self.unchecked += 1
                self._take_block(block, load(self.path, self.file, block))
            case opcode if opcode in _DEFINITIONS:
                self._define(opcode, content(self.path, self.file, frame, limits=self.limits))
            case Opcode.ATTACHMENT:
                attachment = attachment_of(self.path, self.file, frame)
                self.attachments.append(attachment)
                self._count(len(attachment.name) + len(attachment.media_type))

    def _take_block(self, block: Block, data: bytes) -> None:
        segment = survey(self.path, self._blocks, block, records=self._checked(data))
        self._blocks += 1
        if segment is None:
            return
        self.segments.append(segment)
        self.messages += segment.count
        if self.messages > self.limits.messages:
            raise RecordingTooLarge(self.path, f"more than {self.limits.messages} messages")

    def _checked(self, data: bytes) -> Iterator[Record]:
        for frame in entries(self.path, data):
            if frame.opcode == Opcode.MESSAGE:
                record = record_of(self.path, data, frame)
                if record.channel not in self.channels:
                    raise CorruptRecording(self.path, f"a message on channel {record.channel}, which is not there")
                yield record
                continue
            self._others += 1
            if self._others > self.limits.messages:
                raise RecordingTooLarge(self.path, f"more than {self.limits.messages} records besides its messages")
            if frame.opcode in _DEFINITIONS:
                self._define(frame.opcode, data[frame.offset : frame.offset + frame.length])
            elif frame.opcode < _PRIVATE:
                raise CorruptRecording(self.path, f"a chunk holds a record of the kind {frame.opcode}")

    def _define(self, opcode: int, data: bytes) -> None:
        if opcode == Opcode.METADATA:
            name, values = metadata_of(self.path, data)
            self.metadata[name] = values
        elif opcode == Opcode.SCHEMA:
            if not self._defines(self._schemas, *schema_of(self.path, data)):
                return
        elif not self._defines(self.channels, *channel_of(self.path, data, self._schemas)):
            return
        self._count(len(data))

    def _count(self, size: int) -> None:
        """Take note of `size` bytes of definitions."""
        self._defined += size
        if self._defined > self.limits.definitions or len(self.channels) > self.limits.channels:
            raise RecordingTooLarge(self.path, f"{len(self.channels)} channels, {self._defined} bytes of definitions")

    def _defines(self, known: dict[int, T], number: int, item: T) -> bool:
        """Enter a definition; False if the same is there already, as when every chunk repeats them."""
        if known.setdefault(number, item) is item:
            return True
        if known[number] != item:
            raise CorruptRecording(self.path, f"two different definitions have the number {number}")
        return False


def _check_outline(path: Path, file: BinaryIO, size: int, limits: Limits) -> tuple[Statistics | None, bool]:
    """Check sizes and the two long checksums without expanding anything.

    Gives what the file says about itself at its end, and whether its data has a checksum as a whole.
    """
    expanded, data_end, footer, statistics = 0, None, None, None
    for number, frame in enumerate(frames(path, file, size)):
        if number > 2 * limits.messages:
            raise RecordingTooLarge(path, f"more than {2 * limits.messages} records")
        if frame.opcode == Opcode.CHUNK:
            expanded += chunk_head(path, file, frame, limits=limits).block.size
        elif frame.opcode == Opcode.DATA_END and data_end is None:
            data_end = frame
        elif frame.opcode == Opcode.FOOTER:
            footer = frame
        elif frame.opcode == Opcode.STATISTICS:
            statistics = statistics_of(path, content(path, file, frame, limits=limits))
        if expanded > limits.expanded:
            raise RecordingTooLarge(path, f"its chunks expand to more than the {limits.expanded} bytes allowed")
    if data_end is None or footer is None:
        raise CorruptRecording(path, "its data has no end")
    data_crc = Cursor(path, content(path, file, data_end, limits=limits)).u32()
    check_stretch(path, file, start=0, end=data_end.offset - _PREFIX, crc=data_crc)
    end = Cursor(path, content(path, file, footer, limits=limits))
    summary, _, crc = end.u64(), end.u64(), end.u32()
    check_stretch(path, file, start=summary or footer.offset - _PREFIX, end=footer.offset + 16, crc=crc)
    return statistics, bool(data_crc)


def _runs(found: Iterable[Frame]) -> Iterator[Frame]:
    """The same records, with those of messages outside chunks joined as long as they lie side by side."""
    run: Frame | None = None
    for frame in found:
        if run and frame.opcode == Opcode.MESSAGE and run.length + frame.length + _PREFIX <= _RUN:
            run = run._replace(length=run.length + frame.length + _PREFIX)
            continue
        if run:
            yield run
        run = frame if frame.opcode == Opcode.MESSAGE else None
        if run is None:
            yield frame
    if run:
        yield run

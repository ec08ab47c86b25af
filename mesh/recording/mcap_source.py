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
    Expanding,
    Record,
    RecordingStatistics,
    Segment,
    Source,
    check_counts,
    check_definitions,
    check_window,
    load,
    survey,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.limits import Limits
    from mesh.recording.source import Look

T = TypeVar("T")

_RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are taken as one block."""
_PREFIX: Final = 9
_DEFINITIONS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA})
_PRIVATE: Final = 0x80
"""The opcodes from here on are anybody's own."""


def open_mcap(
    path: Path, size: int, limits: Limits, *, look: Look | None = None, progress: Progress | None = None
) -> Source:
    """Check the whole of an MCAP file of `size` bytes; `look` is shown every message, `progress` told of bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is no MCAP file at all.
    """
    with path.open("rb") as file:
        reading = Reading(path, file, limits, look)
        reading.statistics, checked = _check_outline(path, file, size, limits)
        for frame in _runs(frames(path, file, size)):
            if frame.opcode == Opcode.DATA_END:
                break
            reading.take(frame)
            if progress is not None:
                progress(frame.offset + frame.length, size)
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
    look: Look | None = None
    channels: dict[int, Channel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _said: dict[tuple[int, bytes], bytes] = field(default_factory=dict)
    """The last definition of each kind and number, as it is written."""
    _defined: int = 0
    _blocks: int = 0
    _records: int = 0

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
                self._check_counts()

    def _take_block(self, block: Block, data: bytes) -> None:
        segment = survey(self.path, self._blocks, block, records=self._checked(data))
        self._blocks += 1
        self._check_counts()
        if segment is not None:
            self.segments.append(segment)

    def _checked(self, data: bytes) -> Iterator[Record]:
        look, most = self.look, self.limits.messages
        for frame in entries(self.path, data):
            self._records += 1
            if self._records > most:
                self._check_counts()
            if frame.opcode == Opcode.MESSAGE:
                record = record_of(self.path, data, frame)
                channel = self.channels.get(record.channel)
                if channel is None:
                    raise CorruptRecording(self.path, f"a message on channel {record.channel}, which is not there")
                if look is not None:
                    look(channel, record.payload)
                yield record
            elif frame.opcode in _DEFINITIONS:
                self._define(frame.opcode, data[frame.offset : frame.offset + frame.length])
            elif frame.opcode < _PRIVATE:
                raise CorruptRecording(self.path, f"a chunk holds a record of the kind {frame.opcode}")

    def _define(self, opcode: int, data: bytes) -> None:
        if opcode == Opcode.METADATA:
            self._count(len(data))
            name, values = metadata_of(self.path, data)
            self.metadata[name] = values
            return
        definition = opcode, data[:2]
        if self._said.get(definition) == data:  # every chunk may repeat them
            return
        self._count(len(data))
        self._said[definition] = data
        if opcode == Opcode.SCHEMA:
            self._enter(self._schemas, *schema_of(self.path, data))
        else:
            self._enter(self.channels, *channel_of(self.path, data, self._schemas))
            self._count(0)

    def _count(self, size: int) -> None:
        """Take note of `size` bytes of definitions."""
        self._defined += size
        check_definitions(self.path, self.limits, channels=len(self.channels), size=self._defined)

    def _check_counts(self) -> None:
        blocks = self._blocks + len(self.attachments)
        check_counts(self.path, self.limits, records=self._records, blocks=blocks)

    def _enter(self, known: dict[int, T], number: int, item: T) -> None:
        """Enter a definition, unless the same is there already in other words."""
        if known.setdefault(number, item) != item:
            raise CorruptRecording(self.path, f"two different definitions have the number {number}")


def _check_outline(path: Path, file: BinaryIO, size: int, limits: Limits) -> tuple[RecordingStatistics | None, bool]:
    """Check sizes and the two long checksums without expanding anything.

    Gives what the file says about itself at its end, and whether its data has a checksum as a whole.
    """
    expanding, data_end, footer, said = Expanding(path, limits), None, None, None
    for number, frame in enumerate(frames(path, file, size)):
        if number > 2 * limits.messages:
            raise RecordingTooLarge(path, f"more than {2 * limits.messages} records")
        if frame.opcode == Opcode.CHUNK:
            expanding.add(chunk_head(path, file, frame, limits=limits).block)
        elif frame.opcode == Opcode.DATA_END and data_end is None:
            data_end = frame
        elif frame.opcode == Opcode.FOOTER:
            footer = frame
        elif frame.opcode == Opcode.STATISTICS:
            said = frame
    if data_end is None or footer is None:
        raise CorruptRecording(path, "its data has no end")
    data_crc = Cursor(path, content(path, file, data_end, limits=limits)).u32()
    check_stretch(path, file, start=0, end=data_end.offset - _PREFIX, crc=data_crc)
    end = Cursor(path, content(path, file, footer, limits=limits))
    summary, _, crc = end.u64(), end.u64(), end.u32()
    check_stretch(path, file, start=summary or footer.offset - _PREFIX, end=footer.offset + 16, crc=crc)
    return _said(path, file, said, limits), bool(data_crc)


def _said(path: Path, file: BinaryIO, frame: Frame | None, limits: Limits) -> RecordingStatistics | None:
    """The statistics of that frame, if there is one."""
    if frame is None:
        return None
    check_definitions(path, limits, channels=0, size=frame.length)
    return statistics_of(path, content(path, file, frame, limits=limits))


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

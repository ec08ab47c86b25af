"""Reading MCAP files of unknown origin: everything is checked before it is used.

A file is read twice: first only the headers of its records, so that a file that is too large is refused before any of
it is expanded; then completely, chunk by chunk. The index at its end is not used, since it may contain anything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, BinaryIO, Final, TypeVar

from mcap.opcode import Opcode

from mesh.recording.decoding import Cursor
from mesh.recording.errors import CorruptRecording, RecordingTooLarge
from mesh.recording.limits import ExpansionCounter, check_counts, check_definitions, check_window
from mesh.recording.mcap_records import (
    McapRecordHeader,
    attachment_of,
    channel_of,
    check_crc,
    check_range_crc,
    check_record_size,
    chunk_header,
    mcap_records,
    message_of,
    metadata_of,
    read_record,
    records_in_chunk,
    schema_of,
    statistics_of,
)
from mesh.recording.source import (
    Attachment,
    RecordedMessage,
    RecordingBlock,
    RecordingChannel,
    RecordingSource,
    RecordingStatistics,
    Segment,
    load_block,
    reading_file,
    survey_block,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.limits import Limits
    from mesh.recording.source import OnMessage

T = TypeVar("T")

_RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are read as one block."""
_PREFIX: Final = 9
_DEFINITIONS: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA})
_PRIVATE: Final = 0x80
"""Opcodes from here on are for private use."""


def open_mcap(
    path: Path, size: int, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Check the whole of an MCAP file of `size` bytes. `on_message` is called for each message, `progress` with bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is not an MCAP file.
    """
    with path.open("rb") as file:
        reader = McapReader(path, file, limits, on_message)
        reader.statistics, checked = _check_outline(path, file, size, limits)
        for header in _joined_messages(mcap_records(path, file, size)):
            if header.opcode == Opcode.DATA_END:
                break
            reader.read(header)
            if progress is not None:
                progress(header.offset + header.length, size)
    check_window(path, reader.segments, limits)
    if checked:
        reader.unchecked = 0
    return reader.source(size)


def messages_of_chunk(path: Path, data: bytes) -> Iterator[RecordedMessage]:
    """The messages in the decompressed data of a chunk."""
    for header in records_in_chunk(path, data):
        if header.opcode == Opcode.MESSAGE:
            yield message_of(path, data, header)


@dataclass
class McapReader:
    """Reads a file record by record from its beginning, and holds what it has found so far."""

    path: Path
    file: BinaryIO
    limits: Limits
    on_message: OnMessage | None = None
    channels: dict[int, RecordingChannel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    statistics: RecordingStatistics | None = None
    unchecked: int = 0
    repeated: set[str] = field(default_factory=set)
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _definitions_seen: dict[tuple[int, bytes], bytes] = field(default_factory=dict)
    """The bytes of the last definition of each kind and number."""
    _defined: int = 0
    _blocks: int = 0
    _records: int = 0

    def source(self, size: int) -> RecordingSource:
        """The file, as far as it was read."""
        return RecordingSource(
            self.path,
            "mcap",
            size,
            self.channels,
            tuple(self.segments),
            self.metadata,
            partial(reading_file, self.path, partial(messages_of_chunk, self.path)),
            tuple(self.attachments),
            self.statistics,
            self.unchecked,
            frozenset(self.repeated),
        )

    def read(self, header: McapRecordHeader) -> None:
        """Read one record of the file. Messages are checked and counted; only their position is kept."""
        match header.opcode:
            case Opcode.CHUNK:
                head = chunk_header(self.path, self.file, header, limits=self.limits)
                data = load_block(self.path, self.file, head.block)
                check_crc(self.path, data, head.crc)
                self.unchecked += not head.crc
                self._read_block(head.block, data)
            case Opcode.MESSAGE:
                block = RecordingBlock(header.offset - _PREFIX, header.length + _PREFIX, header.length + _PREFIX)
                check_record_size(self.path, block.size, self.limits)
                self.unchecked += 1
                self._read_block(block, load_block(self.path, self.file, block))
            case opcode if opcode in _DEFINITIONS:
                self._define(opcode, read_record(self.path, self.file, header, limits=self.limits))
            case Opcode.ATTACHMENT:
                attachment = attachment_of(self.path, self.file, header)
                self.attachments.append(attachment)
                self._count(len(attachment.name) + len(attachment.media_type))
                self._check_counts()

    def _read_block(self, block: RecordingBlock, data: bytes) -> None:
        segment = survey_block(self.path, self._blocks, block, records=self._messages(data))
        self._blocks += 1
        self._check_counts()
        if segment is not None:
            self.segments.append(segment)

    def _messages(self, data: bytes) -> Iterator[RecordedMessage]:
        on_message, most = self.on_message, self.limits.messages
        for header in records_in_chunk(self.path, data):
            self._records += 1
            if self._records > most:
                self._check_counts()
            if header.opcode == Opcode.MESSAGE:
                message = message_of(self.path, data, header)
                channel = self.channels.get(message.channel)
                if channel is None:
                    raise CorruptRecording(self.path, f"a message on the undefined channel {message.channel}")
                if on_message is not None:
                    on_message(channel, message.payload)
                yield message
            elif header.opcode in _DEFINITIONS:
                self._define(header.opcode, data[header.offset : header.offset + header.length])
            elif header.opcode < _PRIVATE:
                raise CorruptRecording(self.path, f"a chunk holds a record with opcode {header.opcode}")

    def _define(self, opcode: int, data: bytes) -> None:
        if opcode == Opcode.METADATA:
            self._count(len(data))
            name, values = metadata_of(self.path, data)
            if name in self.metadata:
                self.repeated.add(name)
            self.metadata[name] = values
            return
        definition = opcode, data[:2]
        if self._definitions_seen.get(definition) == data:  # each chunk may repeat them
            return
        self._count(len(data))
        self._definitions_seen[definition] = data
        if opcode == Opcode.SCHEMA:
            self._define_once(self._schemas, *schema_of(self.path, data))
        else:
            self._define_once(self.channels, *channel_of(self.path, data, self._schemas))
            self._count(0)

    def _count(self, size: int) -> None:
        """Count `size` bytes of definitions."""
        self._defined += size
        check_definitions(self.path, self.limits, channels=len(self.channels), size=self._defined)

    def _check_counts(self) -> None:
        blocks = self._blocks + len(self.attachments)
        check_counts(self.path, self.limits, records=self._records, blocks=blocks)

    def _define_once(self, known: dict[int, T], number: int, item: T) -> None:
        """Add a definition. Raises `CorruptRecording` if the number is already defined differently."""
        if known.setdefault(number, item) != item:
            raise CorruptRecording(self.path, f"two different definitions have the number {number}")


def _check_outline(path: Path, file: BinaryIO, size: int, limits: Limits) -> tuple[RecordingStatistics | None, bool]:
    """Check sizes and the checksums of data and summary, without expanding anything.

    Returns the file's own statistics, and whether its data as a whole has a checksum.
    """
    expansion, data_end, footer, statistics = ExpansionCounter(path, limits), None, None, None
    for number, header in enumerate(mcap_records(path, file, size)):
        if number > 2 * limits.messages:
            raise RecordingTooLarge(path, f"more than {2 * limits.messages} records", limit="messages")
        if header.opcode == Opcode.CHUNK:
            expansion.add(chunk_header(path, file, header, limits=limits).block)
        elif header.opcode == Opcode.DATA_END and data_end is None:
            data_end = header
        elif header.opcode == Opcode.FOOTER:
            footer = header
        elif header.opcode == Opcode.STATISTICS:
            statistics = header
    if data_end is None or footer is None:
        raise CorruptRecording(path, "its data has no end")
    data_crc = Cursor(path, read_record(path, file, data_end, limits=limits)).u32()
    check_range_crc(path, file, start=0, end=data_end.offset - _PREFIX, crc=data_crc)
    end = Cursor(path, read_record(path, file, footer, limits=limits))
    summary, _, crc = end.u64(), end.u64(), end.u32()
    check_range_crc(path, file, start=summary or footer.offset - _PREFIX, end=footer.offset + 16, crc=crc)
    return _read_statistics(path, file, statistics, limits), bool(data_crc)


def _read_statistics(
    path: Path, file: BinaryIO, header: McapRecordHeader | None, limits: Limits
) -> RecordingStatistics | None:
    """The statistics with that header, if there is one."""
    if header is None:
        return None
    check_definitions(path, limits, channels=0, size=header.length)
    return statistics_of(path, read_record(path, file, header, limits=limits))


def _joined_messages(found: Iterable[McapRecordHeader]) -> Iterator[McapRecordHeader]:
    """The same records, with adjacent messages outside chunks joined to one."""
    run: McapRecordHeader | None = None
    for header in found:
        if run and header.opcode == Opcode.MESSAGE and run.length + header.length + _PREFIX <= _RUN:
            run = run._replace(length=run.length + header.length + _PREFIX)
            continue
        if run:
            yield run
        run = header if header.opcode == Opcode.MESSAGE else None
        if run is None:
            yield header
    if run:
        yield run

"""Reading ROS 1 bags, version 2.0, of unknown origin: closed or cut between two records, indexed or not.

Records are read in file order and the index is not used, since it may contain anything. Bags have no checksums.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, BinaryIO, Final

from mesh.recording.bag_records import (
    CONNECTION,
    BagOp,
    BagRecord,
    bag_records,
    channel_of,
    fields_of,
    message_of,
    number_of,
    records_in_chunk,
)
from mesh.recording.decoding import text_of
from mesh.recording.errors import CorruptRecording, RecordingTooLarge
from mesh.recording.limits import ExpansionCounter, check_counts, check_definitions, check_window
from mesh.recording.source import (
    RecordedMessage,
    RecordingBlock,
    RecordingChannel,
    RecordingSource,
    Segment,
    load_block,
    reading_file,
    survey_block,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.limits import Limits
    from mesh.recording.source import OnMessage

_RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are read as one block."""


def open_bag(
    path: Path, size: int, limits: Limits, *, on_message: OnMessage | None = None, progress: Progress | None = None
) -> RecordingSource:
    """Check the whole of a bag of `size` bytes. `on_message` is called for each message, `progress` with bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is not a bag, or an encrypted one.
    """
    with path.open("rb") as file:
        reader = _BagReader(path, file, limits, on_message)
        for part in _outline(path, file, size, limits):
            reader.read(part)
            if progress is not None:
                progress(part.offset, size)
    check_window(path, reader.segments, limits)
    reading = partial(reading_file, path, partial(_messages_of_chunk, path))
    return RecordingSource(path, "bag", size, reader.channels, tuple(reader.segments), {}, reading)


def _outline(path: Path, file: BinaryIO, size: int, limits: Limits) -> list[RecordingBlock | BagRecord]:
    """The blocks of messages and the connections of a bag in file order. Raises `RecordingTooLarge`.

    Adjacent messages outside chunks become one block.
    """
    found: list[RecordingBlock | BagRecord] = []
    expansion, defined = ExpansionCounter(path, limits), 0
    for number, record in enumerate(bag_records(path, file, size)):
        if number > limits.messages // 2:  # each takes as long as several in a chunk
            why = f"more than {limits.messages // 2} records outside its chunks"
            raise RecordingTooLarge(path, why, limit="messages")
        match record.opcode:
            case BagOp.CHUNK:
                block = _chunk_block(path, record, limits)
                expansion.add(block)
                found.append(block)
            case BagOp.MESSAGE:
                _add_message(path, found, record, limits)
            case BagOp.CONNECTION:
                defined += record.offset - record.begin
                check_definitions(path, limits, channels=0, size=defined)
                found.append(record)
            case BagOp.BAG | BagOp.INDEX | BagOp.CHUNK_INFO:
                pass
            case opcode:
                raise CorruptRecording(path, f"a record with the unknown opcode {opcode}")
        check_counts(path, limits, records=0, blocks=len(found))
    return found


def _add_message(path: Path, found: list[RecordingBlock | BagRecord], record: BagRecord, limits: Limits) -> None:
    """Add a message outside any chunk, to the last block if it is adjacent."""
    whole = record.offset + record.length - record.begin
    if whole > limits.record:
        raise RecordingTooLarge(path, f"a message of {whole} bytes", limit="record")
    last = found[-1] if found else record
    adjacent = isinstance(last, RecordingBlock) and not last.compression and last.offset + last.stored == record.begin
    if isinstance(last, RecordingBlock) and adjacent and last.stored + whole <= _RUN:
        found[-1] = RecordingBlock(last.offset, last.stored + whole, last.size + whole)
    else:
        found.append(RecordingBlock(record.begin, whole, whole))


@dataclass
class _BagReader:
    """Reads a bag block by block, and holds what it has found so far."""

    path: Path
    file: BinaryIO
    limits: Limits
    on_message: OnMessage | None
    channels: dict[int, RecordingChannel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    _defined: int = 0
    _records: int = 0
    _blocks: int = 0
    _connections_seen: dict[int, tuple[dict[bytes, bytes], bytes]] = field(default_factory=dict)

    def read(self, part: RecordingBlock | BagRecord) -> None:
        """Read a block of messages, which are checked and counted, or a connection outside the chunks."""
        if isinstance(part, RecordingBlock):
            self._read_block(part)
            return
        self.file.seek(part.offset)
        self._connect(part, self.file.read(min(part.length, self.limits.definitions + 1)))

    def _read_block(self, block: RecordingBlock) -> None:
        data = load_block(self.path, self.file, block)
        segment = survey_block(self.path, self._blocks, block, records=self._messages(data))
        self._blocks += 1
        if segment is not None:
            self.segments.append(segment)

    def _messages(self, data: bytes) -> Iterator[RecordedMessage]:
        on_message, most = self.on_message, self.limits.messages
        for record in records_in_chunk(self.path, data):
            self._records += 1
            if self._records > most:
                check_counts(self.path, self.limits, records=self._records, blocks=0)
            if record.fields[b"op"] == CONNECTION:
                self._connect(record, data[record.offset : record.offset + record.length])
                continue
            message = message_of(self.path, record, data)
            channel = self.channels.get(message.channel)
            if channel is None:
                raise CorruptRecording(self.path, f"a message of the undefined connection {message.channel}")
            if on_message is not None:
                on_message(channel, message.payload)
            yield message

    def _connect(self, record: BagRecord, data: bytes) -> None:
        number = number_of(self.path, record, b"conn")
        if self._connections_seen.get(number) == (record.fields, data):  # each chunk may repeat them
            return
        self._defined += record.offset - record.begin + len(data)
        count = len(self.channels) + (number not in self.channels)
        check_definitions(self.path, self.limits, channels=count, size=self._defined)
        self._connections_seen[number] = record.fields, data
        channel = channel_of(self.path, record, fields_of(self.path, data))
        if self.channels.setdefault(number, channel) != channel:
            raise CorruptRecording(self.path, f"two different connections have the number {number}")


def _messages_of_chunk(path: Path, data: bytes) -> Iterator[RecordedMessage]:
    for record in records_in_chunk(path, data):
        if record.fields[b"op"] != CONNECTION:
            yield message_of(path, record, data)


def _chunk_block(path: Path, record: BagRecord, limits: Limits) -> RecordingBlock:
    size = number_of(path, record, b"size")
    if max(size, record.length) > limits.record:
        why = f"a chunk expands to {size} bytes, more than the {limits.record} allowed"
        raise RecordingTooLarge(path, why, limit="record")
    compression = text_of(path, record.fields.get(b"compression", b""))
    return RecordingBlock(record.offset, record.length, size, compression)

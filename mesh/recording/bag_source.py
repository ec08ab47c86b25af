"""Reading ROS 1 bags, version 2.0, of unknown origin: closed or cut between two records, indexed or not.

Records are read front to back and their index is not used, since it may say anything. A bag has no checksums of its
own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, BinaryIO, Final

from mesh.recording.bag_records import (
    CONNECTION,
    Op,
    Part,
    channel_of,
    fields_of,
    number_of,
    parts,
    parts_in,
    record_of,
)
from mesh.recording.cursor import text_of
from mesh.recording.errors import CorruptRecording, RecordingTooLarge
from mesh.recording.source import (
    Block,
    Channel,
    Expanding,
    Record,
    Segment,
    Source,
    check_counts,
    check_definitions,
    check_window,
    load,
    survey,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.limits import Limits
    from mesh.recording.source import Look

_RUN: Final = 1 << 20
"""Bytes of messages outside chunks that are taken as one block."""


def open_bag(
    path: Path, size: int, limits: Limits, *, look: Look | None = None, progress: Progress | None = None
) -> Source:
    """Check the whole of a bag of `size` bytes; `look` is shown every message, `progress` told of bytes.

    Raises `CorruptRecording`, `RecordingTooLarge`, and `NotARecording` if it is no bag, or an encrypted one.
    """
    with path.open("rb") as file:
        reading = _Reading(path, file, limits, look)
        for part in _outline(path, file, size, limits):
            reading.take(part)
            if progress is not None:
                progress(part.offset, size)
    check_window(path, reading.segments, limits)
    records = partial(_records_in, path)
    return Source(path, "bag", size, reading.channels, tuple(reading.segments), {}, records)


def _outline(path: Path, file: BinaryIO, size: int, limits: Limits) -> list[Block | Part]:
    """The blocks of messages and the connections of a bag in its order; what is too large is refused here.

    Messages outside chunks are one block as long as they lie side by side.
    """
    found: list[Block | Part] = []
    expanding, defined = Expanding(path, limits), 0
    for number, part in enumerate(parts(path, file, size)):
        if number > limits.messages // 2:  # one takes as long as several in a chunk
            raise RecordingTooLarge(path, f"more than {limits.messages // 2} records outside its chunks")
        match part.opcode:
            case Op.CHUNK:
                block = _chunk_block(path, part, limits)
                expanding.add(block)
                found.append(block)
            case Op.MESSAGE:
                _add_message(path, found, part, limits)
            case Op.CONNECTION:
                defined += part.offset - part.begin
                check_definitions(path, limits, channels=0, size=defined)
                found.append(part)
            case Op.BAG | Op.INDEX | Op.CHUNK_INFO:
                pass
            case opcode:
                raise CorruptRecording(path, f"a record of the unknown kind {opcode}")
        check_counts(path, limits, records=0, blocks=len(found))
    return found


def _add_message(path: Path, found: list[Block | Part], part: Part, limits: Limits) -> None:
    """Take note of a message outside any chunk."""
    whole = part.offset + part.length - part.begin
    if whole > limits.record:
        raise RecordingTooLarge(path, f"a message of {whole} bytes")
    last = found[-1] if found else part
    beside = isinstance(last, Block) and not last.compression and last.offset + last.stored == part.begin
    if isinstance(last, Block) and beside and last.stored + whole <= _RUN:
        found[-1] = Block(last.offset, last.stored + whole, last.size + whole)
    else:
        found.append(Block(part.begin, whole, whole))


@dataclass
class _Reading:
    path: Path
    file: BinaryIO
    limits: Limits
    look: Look | None
    channels: dict[int, Channel] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    _defined: int = 0
    _records: int = 0
    _blocks: int = 0
    _said: dict[int, tuple[dict[bytes, bytes], bytes]] = field(default_factory=dict)

    def take(self, part: Block | Part) -> None:
        """Read a block of messages, which are checked and counted, or a connection outside any."""
        if isinstance(part, Block):
            self._take_block(part)
            return
        self.file.seek(part.offset)
        self._connect(part, self.file.read(min(part.length, self.limits.definitions + 1)))

    def _take_block(self, block: Block) -> None:
        data = load(self.path, self.file, block)
        segment = survey(self.path, self._blocks, block, records=self._checked(data))
        self._blocks += 1
        if segment is not None:
            self.segments.append(segment)

    def _checked(self, data: bytes) -> Iterator[Record]:
        look, most = self.look, self.limits.messages
        for part in parts_in(self.path, data):
            self._records += 1
            if self._records > most:
                check_counts(self.path, self.limits, records=self._records, blocks=0)
            if part.fields[b"op"] == CONNECTION:
                self._connect(part, data[part.offset : part.offset + part.length])
                continue
            record = record_of(self.path, part, data)
            channel = self.channels.get(record.channel)
            if channel is None:
                raise CorruptRecording(self.path, f"a message of connection {record.channel}, which is not there")
            if look is not None:
                look(channel, record.payload)
            yield record

    def _connect(self, part: Part, data: bytes) -> None:
        number = number_of(self.path, part, b"conn")
        if self._said.get(number) == (part.fields, data):  # every chunk may repeat them
            return
        self._defined += part.offset - part.begin + len(data)
        count = len(self.channels) + (number not in self.channels)
        check_definitions(self.path, self.limits, channels=count, size=self._defined)
        self._said[number] = part.fields, data
        channel = channel_of(self.path, part, fields_of(self.path, data))
        if self.channels.setdefault(number, channel) != channel:
            raise CorruptRecording(self.path, f"two different connections have the number {number}")


def _records_in(path: Path, data: bytes) -> Iterator[Record]:
    for part in parts_in(path, data):
        if part.fields[b"op"] != CONNECTION:
            yield record_of(path, part, data)


def _chunk_block(path: Path, part: Part, limits: Limits) -> Block:
    size = number_of(path, part, b"size")
    if max(size, part.length) > limits.record:
        raise RecordingTooLarge(path, f"a chunk expands to {size} bytes, more than the {limits.record} allowed")
    compression = text_of(path, part.fields.get(b"compression", b""))
    return Block(part.offset, part.length, size, compression)

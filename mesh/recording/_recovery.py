"""Recovering recordings: what can be read of a file that is cut or damaged, and what is missing in it."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise, starmap
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from mcap.opcode import Opcode

from mesh.base.private_files import atomic_file
from mesh.recording._bag_reader import MAGIC as BAG_MAGIC
from mesh.recording._bag_reader import BagOp, BagReader, bag_records, read_index
from mesh.recording._mcap import (
    MAGIC,
    McapReader,
    McapRecordHeader,
    McapWriter,
    check_range_crc,
    mcap_records,
    read_record,
    read_summary,
)
from mesh.recording._source import (
    CorruptRecording,
    Cursor,
    Limits,
    NotARecording,
    RecordingError,
    about,
    recording_exists,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from mesh.recording._source import RecordingSource

RECOVERED: Final = "aira-recovered"
"""Name of the metadata record that marks a file, or its first part, as recovered."""

_UNKNOWN: Final = (
    "it can't be known whether messages are missing: the file has no checksum of its data, and no statistics or index"
)
_NO_LIMIT: Final = 1 << 62
_UNLIMITED: Final = Limits(
    size=_NO_LIMIT,
    expanded=_NO_LIMIT,
    bz2=_NO_LIMIT,
    record=1 << 30,
    definitions=1 << 30,
    channels=_NO_LIMIT,
    messages=_NO_LIMIT,
    blocks=_NO_LIMIT,
)


@dataclass(frozen=True, kw_only=True)
class RecoverySummary:
    """What was recovered: `messages` messages, in the file at `path`.

    `why` says what is missing and why, or that this can't be known; it is empty if everything was recovered.
    """

    path: Path
    messages: int
    why: str


def recover(path: Path, target: Path | None = None) -> RecoverySummary:
    """Write what is readable of the MCAP file or bag at `path` to a new, complete MCAP file; the old one is unchanged.

    Without `target` that is `NAME.mcap` for `NAME.mcap.part`, else `NAME.recovered.mcap`. Messages, channels, schemas,
    metadata and attachments are kept; the metadata record `aira-recovered` says what was recovered. A record that is
    damaged is left out, and reading goes on after it, or at the next chunk in the file's index. Of a chunk that is cut
    or can't be decompressed to its end, the whole messages at its beginning are kept; one of which the data has a wrong
    checksum is left out. What was found is compared with what the file states about itself. Blocks on the disk.

    Raises `NotARecording` if it is neither of them, `InputError` if `target` exists, and `OSError`.
    """
    final = target or _name_for(path)
    if final.exists():
        raise recording_exists(final)
    source, why = readable_part(path)
    with atomic_file(final, private=True) as stream:
        writer = McapWriter(stream, profile=None)
        for name, values in source.metadata_records:
            writer.add_metadata(name, values)
        copy_content(source, writer)
        writer.add_metadata(RECOVERED, {"messages": str(writer.messages), "why": why})
        writer.finish()
    return RecoverySummary(path=final, messages=writer.messages, why=why)


def readable_part(path: Path) -> tuple[RecordingSource, str]:
    """What is readable of an MCAP file or a bag, and why that is not all; empty if nothing is missing or damaged.

    Raises `NotARecording` if it begins as neither of them, and `OSError`.
    """
    faults = _Faults()
    size = path.stat().st_size
    with about(path), path.open("rb") as file:
        if file.read(len(BAG_MAGIC)) == BAG_MAGIC:
            source = _read_bag(BagReader(path, file, size, _UNLIMITED, on_fault=faults.add), faults)
        else:
            source = _read_mcap(McapReader(path, file, size, _UNLIMITED, on_fault=faults.add), faults)
    return source, str(faults)


class _Faults:
    """Collects why records can't be read: a `with` block ends at the first, and what follows the block goes on."""

    def __init__(self) -> None:
        self.missing: list[str] = []
        """What the file says that it has, and has not."""
        self._found: Counter[str] = Counter()

    def __bool__(self) -> bool:
        return bool(self.missing or self._found)

    def __str__(self) -> str:
        return "; ".join(self.missing + [f"{why} ({n} times)" if n > 1 else why for why, n in self._found.items()][:10])

    def __enter__(self) -> None:
        pass

    def __exit__(self, _type: object, error: BaseException | None, _trace: object) -> bool:
        if isinstance(error, NotARecording) or not isinstance(error, RecordingError):
            return False
        self.add(error)
        return True

    def add(self, error: RecordingError) -> None:
        self._found[error.why] += 1

    def compare(self, found: int, stated: int, what: str) -> None:
        """Add that some are missing, if fewer were found than the file states."""
        if found < stated:
            self.missing.append(f"{stated - found} of its {stated} {what} are missing")


def _read_mcap(reader: McapReader, faults: _Faults) -> RecordingSource:
    file, size = reader.file, reader.size
    summary, checked = read_summary(file, size, _UNLIMITED), False
    for opcode, data in summary.definitions:  # the chunk that has them may be damaged
        with faults:
            reader.define(opcode, data)

    def part(begin: int, end: int | None) -> Iterator[McapRecordHeader]:
        nonlocal checked
        records = mcap_records(file, size, begin=begin, end=end, cut=True)
        for header in records:
            if header.opcode == Opcode.DATA_END:
                checked = _check_data(file, header)
                break
            yield header
        with suppress(CorruptRecording):  # a summary that is cut lacks no message
            for header in records:
                rest = size - header.offset - header.length - len(MAGIC)
                if header.opcode == Opcode.FOOTER and rest > 0:
                    faults.missing.append(f"{rest} bytes that follow its end")

    edges: list[Any] = [0, *summary.chunk_positions(file), None]
    chunks = _read_parts(reader, starmap(part, pairwise(edges)), Opcode.CHUNK, faults)
    source = reader.source()
    if (stated := summary.statistics) is not None:
        faults.compare(_count(source), stated.messages, "messages")
        faults.compare(len(source.attachments), stated.attachments, "attachments")
        faults.compare(len(source.metadata_records), stated.metadata, "metadata records")
    elif summary.chunks:
        faults.compare(chunks, len(summary.chunks), "chunks")
    elif not checked and not faults:
        faults.missing.append(_UNKNOWN)
    return source


def _read_bag(reader: BagReader, faults: _Faults) -> RecordingSource:
    index = read_index(reader.file, reader.size)
    for connection in index.connections:  # the chunk that has it may be damaged
        with faults:
            reader.read(connection)
    edges = pairwise([0, *sorted(index.positions), reader.size])
    parts = (bag_records(reader.file, end, begin=begin, cut=True) for begin, end in edges)
    chunks = _read_parts(reader, parts, BagOp.CHUNK, faults)
    source = reader.source()
    faults.compare(_count(source), index.messages, "messages")
    faults.compare(chunks, index.chunks, "chunks")
    if not index.is_closed and not faults:
        faults.missing.append("it was not closed: messages may be missing at its end")
    return source


def _read_parts(
    reader: McapReader | BagReader, parts: Iterable[Iterator[Any]], chunk: Opcode | BagOp, faults: _Faults
) -> int:
    """Read what can be read of parts of a file, of which some may be damaged. Returns how many chunks there are."""
    chunks = 0
    for part in parts:
        with faults:
            for record in part:
                chunks += record.opcode == chunk
                with faults:
                    reader.read(record)
                    continue
                if record.opcode == chunk:
                    with suppress(RecordingError):  # what is wrong was added
                        reader.read_damaged_chunk(record)
    return chunks


def _check_data(file: BinaryIO, end: McapRecordHeader) -> bool:
    """Whether the data before its end record has a checksum. Raises `CorruptRecording` if that is wrong."""
    crc = Cursor(read_record(file, end, limits=_UNLIMITED)).u32()
    try:
        check_range_crc(file, start=0, end=end.offset - 9, crc=crc)
    except CorruptRecording:
        why = "the checksum of the data is wrong: what was recovered may be damaged"
        raise CorruptRecording(why) from None
    return crc != 0


def _count(source: RecordingSource) -> int:
    return sum(segment.count for segment in source.segments)


def copy_content(source: RecordingSource, writer: McapWriter) -> None:
    """Write all messages of a source, in file order and on equal channels, and its attachments."""
    copy_attachments(source, writer)
    for number, sequence, log_time, publish_time, payload in source.in_file_order():
        channel, times = source.channels[number], {"log_time_ns": log_time, "publish_time_ns": publish_time}
        writer.add(channel.topic, payload, channel.type, metadata=channel.metadata, sequence=sequence, **times)


def copy_attachments(source: RecordingSource, writer: McapWriter) -> None:
    """Write the attachments of a source."""
    with source.path.open("rb") as stream:
        for attachment in source.attachments:
            stream.seek(attachment.offset)
            writer.add_attachment(attachment, stream.read(attachment.size))


def last_time(source: RecordingSource) -> int:
    """The log time of its last message, in nanoseconds; 0 if it has none."""
    return max((segment.end for segment in source.segments), default=0)


def _name_for(path: Path) -> Path:
    return path.with_suffix("") if path.suffix == ".part" else path.with_suffix(".recovered.mcap")

"""Recovering recordings: what can be read of a file that a crash cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode

from mesh.content.files import atomic_file
from mesh.recording.errors import CorruptRecording, RecordingExists
from mesh.recording.limits import Limits
from mesh.recording.mcap_records import mcap_records
from mesh.recording.mcap_source import McapReader
from mesh.recording.mcap_writer import McapWriter

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.source import RecordingSource

RECOVERED: Final = "aira-recovered"
"""Name of the metadata record that marks a file, or its first part, as recovered."""

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
    """What was recovered: `messages` messages, in the file at `path`. `why` says why not more; empty if all were."""

    path: Path
    messages: int
    why: str


def recover(path: Path, target: Path | None = None) -> RecoverySummary:
    """Write the readable beginning of the MCAP file at `path` to a new, complete file; the old one is unchanged.

    Without `target` that is `NAME.mcap` for `NAME.mcap.part`, else `NAME.recovered.mcap`. Messages, channels, schemas,
    metadata and attachments are kept; the metadata record `aira-recovered` says what was recovered. Reading stops at
    the first record that is cut off or has a wrong checksum. Blocks on the disk.

    Raises `NotARecording` if it is not an MCAP file, `RecordingExists` if `target` exists, and `OSError`.
    """
    final = target or _name_for(path)
    if final.exists():
        raise RecordingExists(final)
    source, why = readable_part(path)
    with atomic_file(final, private=True) as stream:
        writer = McapWriter(stream, profile=None)
        for name, values in source.metadata.items():
            writer.add_metadata(name, values)
        copy_content(source, writer)
        writer.add_metadata(RECOVERED, {"messages": str(writer.messages), "why": why})
        writer.finish()
    return RecoverySummary(path=final, messages=writer.messages, why=why)


def readable_part(path: Path) -> tuple[RecordingSource, str]:
    """The readable beginning of an MCAP file, and why reading stopped there; empty if nothing is missing.

    Raises `NotARecording` if it does not begin as an MCAP file, and `OSError`.
    """
    why = ""
    size = path.stat().st_size
    with path.open("rb") as file:
        reader = McapReader(path, file, _UNLIMITED)
        try:
            for header in mcap_records(path, file, size):
                if header.opcode == Opcode.DATA_END:
                    break
                reader.read(header)
        except CorruptRecording as error:
            why = error.why
    return reader.source(size), why


def copy_content(source: RecordingSource, writer: McapWriter, *, progress: Progress | None = None) -> None:
    """Write all messages of a source, in file order and on equal channels, and its attachments."""
    copy_attachments(source, writer)
    total = sum(segment.count for segment in source.segments)
    for done, (number, sequence, log_time, publish_time, payload) in enumerate(source.in_file_order(), 1):
        channel = source.channels[number]
        writer.add(
            channel.topic,
            payload,
            channel.type,
            metadata=channel.metadata,
            log_time_ns=log_time,
            publish_time_ns=publish_time,
            sequence=sequence,
        )
        if progress is not None:
            progress(done, total)


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

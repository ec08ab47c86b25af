"""Saving what is readable of an MCAP file whose end is missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode

from mesh.recording.errors import CorruptRecording, RecordingExists
from mesh.recording.limits import Limits
from mesh.recording.mcap_file import McapFile, written_durably
from mesh.recording.mcap_records import frames
from mesh.recording.mcap_source import Reading

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording.source import Source

RECOVERED: Final = "aira-recovered"
"""Name of the metadata record that marks a file, or its first part, as recovered."""

PROGRESS_EVERY: Final = 1000
"""Messages between two notes of progress."""

_NO_LIMIT: Final = 1 << 62
_OURS: Final = Limits(
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
    """What was saved: `messages` of them, in the file at `path`; `why` others were not (empty: all were there)."""

    path: Path
    messages: int
    why: str


def recover(path: Path, target: Path | None = None) -> RecoverySummary:
    """Write the readable beginning of the MCAP file at `path` to a new, whole file; the old one is left as it is.

    Without `target` that is `NAME.mcap` for `NAME.mcap.part`, else `NAME.recovered.mcap`. Messages, channels, schemas,
    metadata and attachments are kept; metadata record `aira-recovered` says what was done. Reading stops at the first
    record that is cut or whose checksum is wrong. Blocks on the disk.

    Raises `NotARecording` if it is no MCAP file, `RecordingExists` if `target` is there, `OSError`.
    """
    final = target or _name_for(path)
    if final.exists():
        raise RecordingExists(final)
    source, why = readable_part(path)
    with written_durably(final) as stream:
        file = McapFile(stream)
        for name, values in source.metadata.items():
            file.add_metadata(name, values)
        copy_content(source, file)
        file.add_metadata(RECOVERED, {"messages": str(file.messages), "why": why})
        file.finish()
    return RecoverySummary(path=final, messages=file.messages, why=why)


def readable_part(path: Path) -> tuple[Source, str]:
    """What can be read of an MCAP file from its beginning, and why not more (empty: all its data was there).

    Raises `NotARecording` if it does not even begin as one, `OSError`.
    """
    why = ""
    size = path.stat().st_size
    with path.open("rb") as file:
        reading = Reading(path, file, _OURS)
        try:
            for frame in frames(path, file, size):
                if frame.opcode == Opcode.DATA_END:
                    break
                reading.take(frame)
        except CorruptRecording as error:
            why = error.why
    return reading.source(size), why


def copy_content(source: Source, file: McapFile, *, progress: Progress | None = None) -> None:
    """Write all messages of a source, in the order of their file, with their channels as they are, and what is attached
    to it."""
    with source.path.open("rb") as stream:
        for attachment in source.attachments:
            stream.seek(attachment.offset)
            file.add_attachment(attachment, stream.read(attachment.size))
    total = sum(segment.count for segment in source.segments)
    for done, (number, sequence, log_time, publish_time, payload) in enumerate(source.in_file_order(), 1):
        channel = source.channels[number]
        file.add(
            channel.topic,
            payload,
            channel.type,
            metadata=channel.metadata,
            log_time_ns=log_time,
            publish_time_ns=publish_time,
            sequence=sequence,
        )
        if progress is not None and (done % PROGRESS_EVERY == 0 or done == total):
            progress(done, total)


def _name_for(path: Path) -> Path:
    return path.with_suffix("") if path.suffix == ".part" else path.with_suffix(".recovered.mcap")

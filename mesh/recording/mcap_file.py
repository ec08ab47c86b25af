"""Writing MCAP so that every viewer opens it, and so that no bad argument can spoil the file.

What no record can hold is refused here, in the project's own words, before the writer is called. One owner a file: not
for several threads.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Final

from mesh.content.files import sync_directory
from mesh.recording.errors import Unrecordable
from mesh.recording.mcap_writer import McapWriter

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from mesh.recording.source import Attachment
    from schemas.payloads import PayloadType

CHUNK: Final = 128 << 10
"""Bytes of a chunk: with the package's own 1 MiB, writing one stalls for 13 ms, and a crash loses more."""
MAX_CHANNELS: Final = 0xFFFF
MAX_TIME: Final = (1 << 64) - 1

_JSON_SCHEMA: Final = b'{"type":"object"}'


@dataclass
class FileChannel:
    """A channel of one file: its number there, and the sequence number of its next message."""

    id: int
    sequence: int = 0


class McapFile:
    """An MCAP file that is being written to `stream`, in zstd chunks of 128 KiB.

    `finish` must be called for the file to be whole; the stream stays the caller's to close.
    """

    def __init__(self, stream: BinaryIO, *, profile: str = "") -> None:
        self._writer = McapWriter(stream, chunk_size=CHUNK)
        self._writer.start(profile)
        self._channels: dict[object, FileChannel] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self.messages = 0

    def add(
        self,
        topic: str,
        payload: bytes,
        type: PayloadType,
        *,
        metadata: Mapping[str, str],
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int | None = None,
    ) -> None:
        """Write one message; the channel of its topic, type and metadata is made when first used.

        Without a `sequence`, messages of a channel are numbered from 0. Times are in nanoseconds. Raises
        `Unrecordable`, and then has written nothing; and `OSError`.
        """
        check_message(topic, payload, log_time_ns, publish_time_ns)
        self.write(self.channel(topic, type, metadata), payload, log_time_ns, publish_time_ns, sequence)

    def write(
        self, channel: FileChannel, payload: bytes, log_time_ns: int, publish_time_ns: int, sequence: int | None = None
    ) -> None:
        """Write one message that was checked (see `check_message`) on a channel of this file. Raises `OSError`."""
        number = channel.sequence if sequence is None else sequence
        channel.sequence += 1
        self._writer.add_message(channel.id, log_time_ns, payload, publish_time_ns, number & 0xFFFFFFFF)
        self.messages += 1

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record. Raises `Unrecordable` and `OSError`."""
        for text in (name, *values, *values.values()):
            _check_text(text)
        self._writer.add_metadata(name, dict(values))

    def add_attachment(self, attachment: Attachment, data: bytes) -> None:
        """Write a file into the file: `data` under the names and times of `attachment`. Raises `OSError`."""
        self._writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, data
        )

    def flush(self) -> None:
        """Close the chunk that is open and hand all to the operating system. Raises `OSError`."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the index and the end of the file. Raises `OSError`."""
        self._writer.finish()

    def channel(self, topic: str, type: PayloadType, metadata: Mapping[str, str]) -> FileChannel:
        """The channel of a topic, type and metadata, made when first asked for. Raises `Unrecordable`."""
        key = (topic, type, *metadata.items())
        known = self._channels.get(key)
        if known is not None:
            return known
        if len(self._channels) >= MAX_CHANNELS:
            raise Unrecordable(f"a recording can't hold more than {MAX_CHANNELS} channels")
        for text in (type.encoding, type.schema_name, type.schema_encoding, *metadata, *metadata.values()):
            _check_text(text)
        schema = self._schema(type)
        channel = FileChannel(self._writer.register_channel(topic, type.encoding, schema, metadata))
        self._channels[key] = channel
        return channel

    def _schema(self, type: PayloadType) -> int:
        """The id of the schema of a type. Every channel has one: viewers refuse those that have none."""
        described = (type.schema_name, type.schema_encoding, type.schema_data)
        if type.encoding == "json" and not type.schema_data:
            described = (type.schema_name, "jsonschema", _JSON_SCHEMA)
        if described not in self._schemas:
            self._schemas[described] = self._writer.register_schema(*described)
        return self._schemas[described]


@contextmanager
def written_durably(final: Path) -> Iterator[BinaryIO]:
    """A stream to a file that gets its name, atomically and on the disk, if the block ends without an error."""
    temporary = final.with_name(f"{final.name}.new")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.rename(final)
        sync_directory(final.parent)
    finally:
        temporary.unlink(missing_ok=True)


def check_message(topic: str, payload: object, log_time_ns: object, publish_time_ns: object) -> None:
    """Raise `Unrecordable` for what `mcap.Writer` would choke on after having written half of it."""
    if not isinstance(payload, bytes):
        raise Unrecordable(f"a payload is bytes, not {payload.__class__.__name__}")
    for moment in (log_time_ns, publish_time_ns):
        if not isinstance(moment, int) or not 0 <= moment <= MAX_TIME:
            raise Unrecordable(f"{moment!r} is no time in nanoseconds")
    _check_text(topic)
    if not topic:
        raise Unrecordable("a message without a topic")


def _check_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise Unrecordable(f"{text[:40]!a} has no UTF-8 form") from None

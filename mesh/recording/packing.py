"""Writing messages that come from anywhere to a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mesh.recording.mcap_file import McapFile, written_durably

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from mesh.recording.objective import Played


@dataclass(frozen=True, kw_only=True)
class PackSummary:
    """What was written: how many messages on how many topics, and nanoseconds from the first to the last."""

    messages: int
    topics: int
    duration_ns: int


def pack(
    messages: Iterable[Played], target: Path, *, metadata: Mapping[str, Mapping[str, str]] | None = None
) -> PackSummary:
    """Write messages, in any order, to an MCAP file, with these metadata records. The same messages, the same bytes.

    Sequence numbers are made anew. Replaces what is at `target`, atomically, once all is written. Blocks on the disk.
    Raises `Unrecordable`, `OSError`, and whatever `messages` does; then there is no file.
    """
    first = last = 0
    topics: set[str] = set()
    with written_durably(target) as stream:
        file = McapFile(stream)
        for name, values in (metadata or {}).items():
            file.add_metadata(name, values)
        for message in messages:
            file.add(
                message.topic,
                message.payload,
                message.type,
                metadata={},
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
            first = min(first, message.log_time_ns) if topics else message.log_time_ns
            last = max(last, message.log_time_ns)
            topics.add(message.topic)
        file.finish()
    return PackSummary(messages=file.messages, topics=len(topics), duration_ns=last - first)

"""Converting recordings between MCAP, ROS 1 bags and rosbag2, by the package rosbags (`aira-mesh[ros]`).

Between formats of the same ROS version the payloads keep their bytes; between ROS 1 and ROS 2 they are encoded again.
rosbag2 and bags hold nothing but ROS messages of defined types: what else is in a file is named, and nothing is
written, unless the caller leaves it out.
"""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from mesh.content.files import atomic_file
from mesh.errors import InputError
from mesh.recording.errors import CorruptRecording, NotARecording
from mesh.recording.limits import GENEROUS, Limits
from mesh.recording.mcap_writer import McapWriter
from mesh.recording.objective import open_source
from mesh.recording.recovery import copy_attachments
from mesh.recording.ros_conversion import RosConverter
from mesh.ros import full_ros_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from contextlib import AbstractContextManager
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.recording.ros_conversion import RosConversion
    from mesh.recording.source import RecordedMessage, RecordingChannel, RecordingSource
    from schemas.payloads import PayloadType

    OnRecord: TypeAlias = Callable[[RecordingChannel, RosConversion, RecordedMessage], None]
    FormatWriter: TypeAlias = Callable[
        [Path, Sequence[RecordingSource], str], AbstractContextManager[tuple[Path, OnRecord]]
    ]
    Plan: TypeAlias = dict[int, RosConversion]

RecordingFormat = Literal["mcap", "bag", "rosbag2-mcap", "rosbag2-sqlite3"]
_VERSION: Final = 9
"""Of rosbag2's metadata: that of ROS 2 Jazzy."""
_SUFFIXES: Final = {"MCAP": "mcap", "SQLITE3": "db3"}
_LONGEST_QOS: Final = 64 << 10
METADATA: Final = "metadata.yaml"
"""The file that makes a folder a recording of rosbag2."""


class Unconvertible(InputError, code="unconvertible"):
    """Topics of a recording can't be converted; `topics` says why, by name. Nothing was written."""

    def __init__(self, path: Path, topics: dict[str, str]) -> None:
        why = "; ".join(f"{topic}: {why}" for topic, why in topics.items())
        super().__init__(
            f"{path.name}: {len(topics)} of its topics can't be converted: {why}",
            hint="convert the others with --leave-out, or choose topics with --topic",
        )
        self.topics = topics


@dataclass(frozen=True, kw_only=True)
class ConversionSummary:
    """What was written: the file with the messages, their number, and the topics that were left out, and why."""

    path: Path
    messages: int
    duration_ns: int
    left_out: dict[str, str]


def recording_files(path: Path) -> list[Path]:
    """The files of a recording: `path` itself, or those in the folder of rosbag2 at `path`, in order.

    Raises `NotARecording` for a folder of anything else.
    """
    if not path.is_dir():
        return [path]
    found = [file for file in path.iterdir() if file.suffix in (".mcap", ".db3")]
    if not found or not (path / METADATA).is_file():
        raise NotARecording(path, f"it is a folder without {METADATA} and files of rosbag2 (.mcap, .db3)")
    return sorted(found, key=lambda file: (len(file.name), file.name))  # NAME_9.mcap, NAME_10.mcap


def recording_file(path: Path) -> Path:
    """The file of a recording that has only one: `path` itself, or that in the folder of rosbag2. Other folders stay.

    Raises `NotARecording` for a folder with several files.
    """
    if not (path / METADATA).is_file():
        return path
    first, *others = recording_files(path)
    if others:
        why = f"it has {len(others) + 1} files; join them in one: aira objective convert {path.name} {path.name}.mcap"
        raise NotARecording(path, why)
    return first


def convert(
    source: Path,
    target: Path,
    *,
    to: RecordingFormat,
    topics: Sequence[str] = (),
    leave_out: bool = False,
    distribution: str = "jazzy",
    cid: str = "",
    limits: Limits = GENEROUS,
    progress: Progress | None = None,
) -> ConversionSummary:
    """Convert the recording at `source`, a file or a folder of rosbag2, to a new file or folder at `target`.

    `topics` are patterns (`/camera/*`; none: all topics). Types that the recording does not define are those of the
    ROS `distribution`. `cid`, the source's own, goes into an MCAP file's metadata. Replaces no file. Blocks on the
    disk. Raises `Unconvertible`, what `open_objective` does, `OSError`, and without rosbags `PackageMissing`.
    """
    sources = [open_source(path, limits) for path in recording_files(source)]
    converter = RosConverter(_VERSIONS[to], distribution)
    plans, left_out = _plans(sources, converter, topics)
    if left_out and not leave_out:
        raise Unconvertible(source, left_out)
    total = sum(segment.count for each in sources for segment in each.segments)
    count, first, last = 0, 0, 0
    with _WRITERS[to](target, sources, cid) as (path, add):
        for channel, conversion, message in _messages(sources, plans):
            add(channel, conversion, message)
            first, last = min(first, message.log_time) if count else message.log_time, max(last, message.log_time)
            count += 1
            if progress is not None:
                progress(count, total)
    return ConversionSummary(path=path, messages=count, duration_ns=last - first, left_out=left_out)


def _plans(
    sources: Sequence[RecordingSource], converter: RosConverter, topics: Sequence[str]
) -> tuple[list[Plan], dict[str, str]]:
    """For each source how its channels are converted, by number; and what can't be, by topic."""
    plans, left_out = [], {}
    conversions: dict[PayloadType, RosConversion] = {}
    for source in sources:
        plan: Plan = {}
        for number, channel in source.channels.items():
            if topics and not any(fnmatchcase(channel.topic, pattern) for pattern in topics):
                continue
            if channel.type not in conversions:
                conversions[channel.type] = converter.of(channel.type)
            conversion = conversions[channel.type]
            if conversion.why:
                left_out[channel.topic] = conversion.why
            else:
                plan[number] = conversion
        plans.append(plan)
    return plans, left_out


def _messages(
    sources: Sequence[RecordingSource], plans: Sequence[Plan]
) -> Iterator[tuple[RecordingChannel, RosConversion, RecordedMessage]]:
    """The converted messages, in file order. Raises `CorruptRecording` for one that is not of its type."""
    for source, plan in zip(sources, plans, strict=True):
        for message in source.in_file_order():
            conversion = plan.get(message.channel)
            if conversion is None:
                continue
            channel = source.channels[message.channel]
            try:
                payload = conversion.convert(message.payload)
            except Exception as error:  # the converter is made from the file's definitions, and may fail in any way
                why = f"a message on {channel.topic} is no {channel.type.schema_name}: {error}"
                raise CorruptRecording(source.path, why) from None
            yield channel, conversion, message._replace(payload=payload)


@contextmanager
def _mcap_file(target: Path, sources: Sequence[RecordingSource], cid: str) -> Iterator[tuple[Path, OnRecord]]:
    is_ros1 = all(channel.type.encoding == "ros1" for each in sources for channel in each.channels.values())
    with atomic_file(target) as stream:
        writer = McapWriter(stream, profile="ros1" if is_ros1 else None)
        writer.add_metadata("aira", {"source": cid, "source_format": sources[0].format})

        def add(channel: RecordingChannel, conversion: RosConversion, message: RecordedMessage) -> None:
            times = {"log_time_ns": message.log_time, "publish_time_ns": message.publish_time}
            of, metadata = conversion.type, channel.metadata
            writer.add(channel.topic, message.payload, of, metadata=metadata, sequence=message.sequence, **times)

        yield target, add
        for source in sources:
            copy_attachments(source, writer)
        writer.finish()


@contextmanager
def _bag_file(target: Path, _sources: Sequence[RecordingSource], _cid: str) -> Iterator[tuple[Path, OnRecord]]:
    from rosbags.rosbag1 import Writer

    with _beside(target) as partial_file:
        with Writer(partial_file) as writer:
            connections: dict[tuple[str, PayloadType], Any] = {}

            def add(channel: RecordingChannel, conversion: RosConversion, message: RecordedMessage) -> None:
                of = conversion.type
                if (channel.topic, of) not in connections:
                    text = of.schema_data.decode()
                    connections[channel.topic, of] = writer.add_connection(
                        channel.topic, full_ros_name(of.schema_name), msgdef=text, md5sum=conversion.digest
                    )
                writer.write(connections[channel.topic, of], message.log_time, message.payload)

            yield target, add
        partial_file.rename(target)


@contextmanager
def _rosbag2_folder(storage: str, target: Path, *_: object) -> Iterator[tuple[Path, OnRecord]]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin[storage]
    with _beside(target) as folder:
        with Writer(folder, version=_VERSION, storage_plugin=plugin) as writer:
            connections: dict[tuple[str, PayloadType], Any] = {}

            def add(channel: RecordingChannel, conversion: RosConversion, message: RecordedMessage) -> None:
                of = conversion.type
                if (channel.topic, of) not in connections:
                    connections[channel.topic, of] = writer.add_connection(
                        channel.topic,
                        full_ros_name(of.schema_name),
                        msgdef=of.schema_data.decode(),
                        rihs01=conversion.digest,
                        offered_qos_profiles=_qos(channel),
                    )
                writer.write(connections[channel.topic, of], message.log_time, message.payload)

            yield target / f"{target.name}.{_SUFFIXES[storage]}", add
        folder.rename(target)


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """A path of the same name in a folder beside the target, which is deleted at the end."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        yield Path(folder) / target.name


def _qos(channel: RecordingChannel) -> Any:
    """The QoS that a channel's metadata state: of rosbag2, or latching of ROS 1. None that is not readable."""
    from rosbags.convert.converter import LATCH
    from rosbags.rosbag2.metadata import parse_qos

    if channel.metadata.get("latching") == "1":
        return LATCH
    text = channel.metadata.get("offered_qos_profiles", "")
    try:
        return parse_qos(text) if 0 < len(text) <= _LONGEST_QOS else ()
    except Exception:  # of a stranger's text
        return ()


_VERSIONS: Final = {"mcap": 0, "bag": 1, "rosbag2-mcap": 2, "rosbag2-sqlite3": 2}
"""The version of ROS of each format; 0 for any."""
_WRITERS: Final[dict[str, FormatWriter]] = {
    "mcap": _mcap_file,
    "bag": _bag_file,
    "rosbag2-mcap": partial(_rosbag2_folder, "MCAP"),
    "rosbag2-sqlite3": partial(_rosbag2_folder, "SQLITE3"),
}

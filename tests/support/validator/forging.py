"""Ways to forge a recording: its messages, its metadata, its statistics, its bytes."""

from __future__ import annotations

import io
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import msgspec
from mcap.writer import Writer

from mesh.recording import ABOUT, CLOCK_RECORD, CLOSED, RECOVERED, open_objective
from mesh.recording._mcap import McapWriter
from schemas import cid_of_file
from tests.support.validator.lamps import ROBOT, FinishedJob, signed_by

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import TypeAlias

    from mcap.records import Statistics

    from mesh.recording import Played

    Metadata: TypeAlias = dict[str, dict[str, str]]
    Change: TypeAlias = Callable[["Forgery"], object]
    Tamper: TypeAlias = Callable[[FinishedJob], FinishedJob]


@dataclass
class Forgery:
    """The content of a recording, to be changed."""

    messages: list[Played]
    metadata: Metadata
    statistics: dict[str, Any]
    """Fields of the statistics to be stated instead of the true ones."""
    more_metadata: list[tuple[str, dict[str, str]]]
    """Metadata records to be written besides, under names that are there already."""

    def edit(self, number: int, /, **fields: Any) -> None:
        """Change fields of a message."""
        self.messages[number] = msgspec.structs.replace(self.messages[number], **fields)

    def edit_all(self, topic: str, /, **fields: Any) -> None:
        """Change fields of all messages on a topic."""
        for number in self.on(topic):
            self.edit(number, **fields)

    def drop_all(self, *topics: str) -> None:
        """Leave out all messages on these topics."""
        self.drop(*(number for topic in topics for number in self.on(topic)))

    def begun(self) -> int:
        """When the recorder was opened, by its clock."""
        return int(self.metadata[CLOCK_RECORD]["unix_ns"])

    def on(self, topic: str) -> list[int]:
        """The numbers of the messages on a topic."""
        return [number for number, message in enumerate(self.messages) if message.topic == topic]

    def drop(self, *numbers: int) -> None:
        """Leave out messages."""
        self.messages = [message for number, message in enumerate(self.messages) if number not in numbers]

    def shift(self, nanoseconds: int, *, since: int = 0) -> None:
        """Move the messages from number `since` on in time."""
        for number in range(since, len(self.messages)):
            time = self.messages[number].log_time_ns + nanoseconds
            self.edit(number, log_time_ns=time, publish_time_ns=time)

    def set_clock(self, *times: object, log: tuple[object, ...] | None = None) -> None:
        """Write these times of day as those at which the recorder was opened."""
        unix = ",".join(map(str, times))
        self.metadata[CLOCK_RECORD] = {"unix_ns": unix, "log_ns": unix if log is None else ",".join(map(str, log))}

    def recovered(self, *seams: object) -> None:
        """State crashes after these numbers of messages."""
        text = ",".join(map(str, seams))
        self.metadata[RECOVERED] = {"messages": text.rpartition(",")[2], "seams": text, "why": "it is cut off"}

    def cover_up(self) -> None:
        """Number the messages of each channel without gaps, in the order of time, and close with their count."""
        counts: Counter[tuple[str, str, str]] = Counter()
        times = sorted(message.log_time_ns for message in self.messages)
        for number, (message, time) in enumerate(zip(self.messages, times, strict=True)):
            channel = message.topic, message.role, message.type.zenoh_encoding
            self.edit(number, sequence=counts[channel], log_time_ns=time, publish_time_ns=time)
            counts[channel] += 1
        if CLOSED in self.metadata:
            self.metadata[CLOSED]["messages"] = str(len(self.messages))

    @property
    def about(self) -> dict[str, str]:
        """The metadata that name the job."""
        return self.metadata[ABOUT]


class _ForgingWriter(McapWriter):
    """Writes a file with false statistics."""

    false: dict[str, Any]

    def _statistics(self) -> Statistics:
        statistics = super()._statistics()
        for name, value in self.false.items():
            setattr(statistics, name, value(getattr(statistics, name)))
        return statistics


def read(path: Path) -> Forgery:
    """The content of a recording."""
    recording = open_objective(path)
    metadata = {name: dict(values) for name, values in recording.metadata.items()}
    return Forgery([one.message for one in recording.in_file_order()], metadata, {}, [])


def write(path: Path, forgery: Forgery) -> None:
    """Write a recording with that content, as its recorder would."""
    with path.open("wb") as stream:
        writer = _ForgingWriter(stream)
        writer.false = forgery.statistics
        for name, values in [*forgery.metadata.items(), *forgery.more_metadata]:
            writer.add_metadata(name, values)
        for message in forgery.messages:
            writer.add(
                message.topic,
                message.payload,
                message.type,
                metadata={"role": message.role} if message.role else {},
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
                sequence=message.sequence,
            )
        writer.finish()


def signed(job: FinishedJob, *, by: Any = ROBOT) -> FinishedJob:
    """The job with a Result for the recording that is there now."""
    return replace(job, message=signed_by(by, job.liability.address, cid_of_file(job.recording)))


def naive(*changes: Change) -> Tamper:
    """Forge the content of the recording, and sign it."""

    def tamper(job: FinishedJob) -> FinishedJob:
        forgery = read(job.recording)
        for change in changes:
            change(forgery)
        write(job.recording, forgery)
        return signed(job)

    return tamper


def covered(*changes: Change) -> Tamper:
    """The same, with the traces in numbers, times and counts covered up."""
    return naive(*changes, Forgery.cover_up)


def raw(change: Callable[[bytes], bytes]) -> Tamper:
    """Change the bytes of the recording, and sign it."""

    def tamper(job: FinishedJob) -> FinishedJob:
        job.recording.write_bytes(change(job.recording.read_bytes()))
        return signed(job)

    return tamper


def by_another_writer(**options: Any) -> Tamper:
    """Write the same content with the package `mcap` and these options, and sign it."""

    def tamper(job: FinishedJob) -> FinishedJob:
        job.recording.write_bytes(_written(read(job.recording), **options))
        return signed(job)

    return tamper


def _written(forgery: Forgery, **options: Any) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    for name, values in forgery.metadata.items():
        writer.add_metadata(name, values)
    channels: dict[tuple[str, str, str], int] = {}
    for message in forgery.messages:
        key = message.topic, message.role, message.type.zenoh_encoding
        if key not in channels:
            kind = message.type
            schema = writer.register_schema(kind.schema_name, kind.schema_encoding, kind.schema_data)
            channels[key] = writer.register_channel(message.topic, kind.encoding, schema, {"role": message.role})
        writer.add_message(
            channels[key], message.log_time_ns, message.payload, message.publish_time_ns, message.sequence
        )
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def changed(**fields: Any) -> Tamper:
    """The job with other fields; a function gets the job."""

    def tamper(job: FinishedJob) -> FinishedJob:
        return replace(job, **{name: value(job) if callable(value) else value for name, value in fields.items()})

    return tamper


def both(*tampers: Tamper) -> Tamper:
    """One after the other."""

    def tamper(job: FinishedJob) -> FinishedJob:
        for one in tampers:
            job = one(job)
        return job

    return tamper


def swapped(one: int, other: int) -> Change:
    """Exchange two messages."""

    def change(forgery: Forgery) -> None:
        messages = forgery.messages
        messages[one], messages[other] = messages[other], messages[one]

    return change

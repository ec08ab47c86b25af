"""Checks of a recording by itself: whether it is as a recorder writes it, with nothing missing, moved or added."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, get_args

from mesh.evidence.claims import Finding
from mesh.recording import ABOUT, CLOSED, NOTE_TOPIC, RECOVERED, MessageRole

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.recording import ChannelMessage, Objective

MILLISECOND: Final = 10**6
_ROLES: Final = frozenset(get_args(MessageRole))


@dataclass
class _Faults:
    """The first fault of a kind, and how many there are: a stranger's file may have any number."""

    first: str = ""
    count: int = 0

    def add(self, fault: str) -> None:
        self.first = self.first or fault
        self.count += 1

    def finding(self, name: str, well: str) -> Finding:
        """The finding of that name: the first fault, or that all is `well`."""
        if not self.count:
            return Finding(name, True, well)
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return Finding(name, False, self.first + more)


@dataclass(slots=True)
class _ChannelCount:
    """What was read of one channel."""

    topic: str
    role: str
    count: int = 0
    next: int = 0


@dataclass
class SequenceCheck:
    """Checks the messages of a recording in file order for missing, repeated and moved ones."""

    channels: dict[int, _ChannelCount] = field(default_factory=dict)
    gaps: _Faults = field(default_factory=_Faults)
    steps_back: _Faults = field(default_factory=_Faults)
    copies: _Faults = field(default_factory=_Faults)
    last: ChannelMessage | None = None

    def add(self, written: ChannelMessage) -> None:
        """Check the next message."""
        message = written.message
        channel = self.channels.get(written.channel)
        if channel is None:
            channel = self.channels[written.channel] = _ChannelCount(message.topic, message.role)
        if message.sequence != channel.next:
            self.gaps.add(_gap(message.topic, message.sequence, channel.next))
        channel.count += 1
        channel.next = message.sequence + 1
        if self.last is not None:
            self._compare(written, self.last)
        self.last = written

    def _compare(self, written: ChannelMessage, last: ChannelMessage) -> None:
        """Compare a message with the one before it."""
        message, earlier = written.message, last.message.log_time_ns - written.message.log_time_ns
        if earlier < 0:
            return
        name = f"message {message.sequence} on {message.topic}"
        if earlier > 0:
            self.steps_back.add(f"{name} was recorded {earlier / MILLISECOND:g} ms before the previous one")
        elif written.channel == last.channel and message.payload == last.message.payload:
            self.copies.add(f"{name} has the time and content of the one before it")


def check_completeness(recording: Objective, sequence: SequenceCheck) -> Iterator[Finding]:
    """Check a recording whose messages were all added to `sequence`."""
    if recording.unchecked:
        yield Finding("readable", None, f"{recording.unchecked} blocks of it have no checksum")
    else:
        yield Finding("readable", True, f"{recording.count} messages, and every checksum is right")
    yield _check_statistics(recording, sequence)
    yield _check_closed(recording)
    yield sequence.gaps.finding("sequence", "the messages of every channel are numbered without a gap")
    yield sequence.steps_back.finding("times", "the messages are in the order of their times")
    yield sequence.copies.finding("duplicates", "no message is a copy of the one before")
    yield _check_roles(recording, sequence)


def _gap(topic: str, number: int, expected: int) -> str:
    if number < expected:
        return f"message {number} on {topic} comes after message {expected - 1}"
    if number == expected + 1:
        return f"message {expected} on {topic} is missing"
    return f"messages {expected} to {number - 1} on {topic} are missing"


def _check_statistics(recording: Objective, sequence: SequenceCheck) -> Finding:
    said = recording.statistics
    if said is None:
        return Finding("statistics", False, "the file does not state how many messages it has")
    if said.messages != recording.count:
        return Finding("statistics", False, f"the file states {said.messages} messages, and has {recording.count}")
    counted = {number: channel.count for number, channel in sequence.channels.items()}
    if {number: count for number, count in said.by_channel.items() if count} != counted:
        return Finding("statistics", False, "the file states other numbers of messages on its channels than it has")
    if recording.count and (said.start, said.end) != (recording.start_ns, recording.start_ns + recording.duration_ns):
        return Finding("statistics", False, "the file states other times of its first and last message than it has")
    if (said.channels, said.attachments) != (recording.channels, len(recording.attachments)):
        return Finding("statistics", False, "the file states other numbers of channels and attachments than it has")
    return Finding("statistics", True, "the file has the messages, channels and times that it states")


def _check_closed(recording: Objective) -> Finding:
    if recording.repeated:
        name = min(recording.repeated)
        return Finding("closed", False, f"it has several metadata records {name[:80]!r}, and a recorder writes one")
    closing = recording.metadata.get(CLOSED)
    if closing is None:
        return Finding("closed", False, "the recorder did not close it: the end may be missing")
    if closing.get("messages") != str(recording.count):
        stated = closing.get("messages", "unknown")[:20]
        said = f"the recorder closed it with {stated} messages, and it has {recording.count}"
        return Finding("closed", False, said)
    if closing.get("lost") != "0":
        return Finding("closed", False, f"the recorder lost {closing.get('lost', 'unknown')[:20]} messages")
    if RECOVERED in recording.metadata:
        return Finding("closed", None, "the agent crashed and continued: the last second before may be missing")
    return Finding("closed", True, "the recorder closed it and had lost nothing")


def _check_roles(recording: Objective, sequence: SequenceCheck) -> Finding:
    """Whether each channel says who sent its messages, and may carry them."""
    chosen = chosen_topics(recording)
    for channel in sequence.channels.values():
        if channel.role not in _ROLES:
            said = f"the messages on {channel.topic} have the unknown role {channel.role[:40]!r}"
            return Finding(
                "roles", False, said if channel.role else f"nothing says who sent the messages on {channel.topic}"
            )
        if channel.role == "agent" and channel.topic != NOTE_TOPIC:
            return Finding(
                "roles", False, f"messages on {channel.topic} are the agent's, which writes on {NOTE_TOPIC} only"
            )
        if chosen and channel.role != "agent" and channel.topic not in chosen:
            return Finding("roles", False, f"it has messages on {channel.topic}, which was not to be recorded")
    return Finding("roles", True, "every channel says who sent its messages, and may carry them")


def chosen_topics(recording: Objective) -> frozenset[str]:
    """The topics that the recorder was told to record; empty for all."""
    return frozenset(name for name in recording.metadata.get(ABOUT, {}).get("topics", "").split(",") if name)

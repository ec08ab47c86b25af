"""Whether a recording is all there: closed, counted, numbered without a gap. Pure but for reading the file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from mesh.evidence.findings import Finding
from mesh.recording import CLOSED, RECOVERED

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.recording import ChannelMessage, Objective

MILLISECOND: Final = 10**6


@dataclass
class _Channel:
    """What was seen of one channel."""

    count: int = 0
    next: int = 0
    last_time: int = 0


@dataclass
class Numbering:
    """Takes the messages of a recording in the order of the file, and finds what is missing, doubled or moved."""

    channels: dict[int, _Channel] = field(default_factory=dict)
    gaps: list[str] = field(default_factory=list)
    steps_back: list[str] = field(default_factory=list)

    def take(self, written: ChannelMessage) -> None:
        """Look at the next message."""
        message = written.message
        channel = self.channels.setdefault(written.channel, _Channel())
        if message.sequence != channel.next:
            self.gaps.append(_gap(written, channel.next))
        if message.log_time_ns < channel.last_time:
            name, earlier = f"message {message.sequence} on {message.topic}", channel.last_time - message.log_time_ns
            self.steps_back.append(f"{name} was recorded {earlier / MILLISECOND:g} ms before the one in front of it")
        channel.count += 1
        channel.next = message.sequence + 1
        channel.last_time = message.log_time_ns


def check_completeness(recording: Objective, numbering: Numbering) -> Iterator[Finding]:
    """Findings on a recording that was read, and whose messages `numbering` has taken."""
    if recording.unchecked:
        yield Finding("readable", None, f"{recording.unchecked} blocks of it have no checksum")
    else:
        yield Finding("readable", True, f"{recording.count} messages, and every checksum is right")
    yield _statistics(recording, numbering)
    yield _closed(recording)
    yield _all_well("sequence", numbering.gaps, "the messages of every channel are numbered without a gap")
    yield _all_well("times", numbering.steps_back, "no message of a channel was recorded before the one in front of it")


def _gap(written: ChannelMessage, expected: int) -> str:
    topic, number = written.message.topic, written.message.sequence
    if number < expected:
        return f"message {number} on {topic} comes after message {expected - 1}"
    if number == expected + 1:
        return f"message {expected} on {topic} is missing"
    return f"messages {expected} to {number - 1} on {topic} are missing"


def _all_well(name: str, faults: list[str], well: str) -> Finding:
    if not faults:
        return Finding(name, True, well)
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return Finding(name, False, faults[0] + more)


def _statistics(recording: Objective, numbering: Numbering) -> Finding:
    said = recording.statistics
    if said is None:
        return Finding("statistics", False, "the file does not say how many messages it has")
    if said.messages != recording.count:
        return Finding("statistics", False, f"the file says {said.messages} messages, and has {recording.count}")
    counted = {number: channel.count for number, channel in numbering.channels.items()}
    if {number: count for number, count in said.by_channel.items() if count} != counted:
        return Finding("statistics", False, "the file says other numbers of messages on its channels than it has")
    if recording.count and (said.start, said.end) != (recording.start_ns, recording.start_ns + recording.duration_ns):
        return Finding("statistics", False, "the file says other times of its first and last message than it has")
    return Finding("statistics", True, "the file has what it says: messages, channels, times")


def _closed(recording: Objective) -> Finding:
    closing = recording.metadata.get(CLOSED)
    if closing is None:
        return Finding("closed", False, "the recorder did not close it: what came last may be missing")
    if closing.get("messages") != str(recording.count):
        return Finding(
            "closed",
            False,
            f"the recorder closed it with {closing.get('messages', 'unknown')[:20]} messages, and it has"
            f" {recording.count}",
        )
    if closing.get("lost") != "0":
        return Finding("closed", False, f"the recorder lost {closing.get('lost', 'unknown')[:20]} messages")
    if RECOVERED in recording.metadata:
        return Finding(
            "closed", None, "the agent broke down meanwhile and went on: what was said in the second before is missing"
        )
    return Finding("closed", True, "the recorder closed it and had lost nothing")

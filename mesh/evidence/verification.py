"""Verifying a job: its two files against the claim, and the recording for completeness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.evidence.claims import Finding, Verdict, check_about, check_end, check_signature, supplemented
from mesh.evidence.playback import MessageDigest, check_played, digest_of
from mesh.recording import ABOUT, CLOSED, GENEROUS, RECOVERED, RecordingError, open_objective
from schemas import cid_of_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import TypeAlias

    from mesh.content import Progress
    from mesh.evidence.claims import Claim
    from mesh.recording import ChannelMessage, Objective

    Opener: TypeAlias = Callable[[Path], Objective]

_MILLISECOND: Final = 10**6


def verify(
    claim: Claim,
    *,
    objective: Path,
    result: Path,
    message: bytes | None = None,
    objective_cid: str = "",
    result_cid: str = "",
    progress: Progress | None = None,
) -> Verdict:
    """Check everything that can be checked: the files behind the two CIDs, the signature, the recording.

    `message` is the encoded Result, if at hand. Pass the CIDs of files that were fetched by them: a CID made with other
    settings than ours can't be computed from the file. `progress` is called with the bytes of both files read, of all.
    Use a thread. Raises `OSError` if a file can't be read.
    """
    cids = objective_cid or cid_of_file(objective), result_cid or cid_of_file(result)
    open_next = _opener(result, objective, progress)
    return Verdict(tuple(_check_all(claim, objective, result, message, *cids, open_next)))


def _opener(first: Path, second: Path, progress: Progress | None) -> Opener:
    """Opens two files one after the other, and calls `progress` for both together."""
    sizes = first.stat().st_size, second.stat().st_size
    before = iter((0, sizes[0]))

    def open_next(path: Path) -> Objective:
        start = next(before)
        tell = None if progress is None else lambda done, _: progress(start + done, sum(sizes))
        return open_objective(path, GENEROUS, progress=tell)

    return open_next


def _check_all(
    claim: Claim,
    objective: Path,
    result: Path,
    message: bytes | None,
    objective_cid: str,
    result_cid: str,
    open_next: Opener,
) -> Iterator[Finding]:
    yield check_end(claim)
    yield check_signature(claim, message, recording=result_cid)
    claim = supplemented(claim, message)
    yield _check_file("result-file", "result", result_cid, claim.result)
    yield _check_file("objective-file", "objective", objective_cid, claim.objective)
    if not claim.objective:
        # Without a contract, still check that the two files belong together.
        claim = msgspec.structs.replace(claim, objective=objective_cid)
    try:
        recording = open_next(result)
    except RecordingError as error:
        yield Finding("readable", False, f"the recording is not readable: {error.why}")
        return
    yield from _check_recording(claim, recording, objective, open_next)


def _check_recording(claim: Claim, recording: Objective, path: Path, open_next: Opener) -> Iterator[Finding]:
    sequence, played, seams = SequenceCheck(), list[MessageDigest](), list[int]()
    breaks = _numbers(recording.metadata.get(RECOVERED, {}).get("seams", ""))
    for number, written in enumerate(recording.in_file_order()):
        if number in breaks:
            seams.append(len(played))
        sequence.add(written)
        if written.message.role == "objective":
            played.append(digest_of(written.message))
    yield from check_completeness(recording, sequence)
    yield from check_about(claim, recording.metadata)
    try:
        objective = open_next(path)
    except RecordingError as error:
        why = f"the objective is not a recording ({error.why})"
        if played:
            yield Finding("played", False, f"messages were played, but {why}")
        else:
            yield Finding("played", None, f"nothing was played: {why}")
        return
    yield _check_playback(claim, recording, objective, played, seams)


def _check_playback(
    claim: Claim, recording: Objective, objective: Objective, played: list[MessageDigest], seams: list[int]
) -> Finding:
    chosen = {name for name in recording.metadata.get(ABOUT, {}).get("topics", "").split(",") if name}
    due = [digest_of(message) for message in objective.messages() if not chosen or message.topic in chosen]
    finding = check_played(due, played, seams=seams, complete=claim.success is not False)
    if chosen:
        said = f"{finding.detail}; only {len(chosen)} topics were recorded"
        return Finding(finding.name, finding.holds, said)
    return finding


def _check_file(name: str, what: str, cid: str, claimed: str) -> Finding:
    if not claimed:
        return Finding(name, None, f"the {what} is {cid}, with nothing to compare it to")
    if cid != claimed:
        return Finding(name, False, f"the {what} is {cid}, and it should be {claimed}")
    return Finding(name, True, f"the {what} is {cid}")


def _numbers(text: str) -> frozenset[int]:
    """Numbers separated by commas. Anything else is skipped: the text is untrusted."""
    return frozenset(int(word) for word in text.split(",") if word.isascii() and word.isdigit() and len(word) < 20)


@dataclass
class _ChannelCount:
    """What was read of one channel."""

    count: int = 0
    next: int = 0
    last_time: int = 0


@dataclass
class SequenceCheck:
    """Checks the messages of a recording in file order for missing, repeated and moved ones."""

    channels: dict[int, _ChannelCount] = field(default_factory=dict)
    gaps: list[str] = field(default_factory=list)
    steps_back: list[str] = field(default_factory=list)

    def add(self, written: ChannelMessage) -> None:
        """Check the next message."""
        message = written.message
        channel = self.channels.setdefault(written.channel, _ChannelCount())
        if message.sequence != channel.next:
            self.gaps.append(_gap(written, channel.next))
        if message.log_time_ns < channel.last_time:
            name, earlier = f"message {message.sequence} on {message.topic}", channel.last_time - message.log_time_ns
            self.steps_back.append(f"{name} was recorded {earlier / _MILLISECOND:g} ms before the previous one")
        channel.count += 1
        channel.next = message.sequence + 1
        channel.last_time = message.log_time_ns


def check_completeness(recording: Objective, sequence: SequenceCheck) -> Iterator[Finding]:
    """Check a recording whose messages were all added to `sequence`."""
    if recording.unchecked:
        yield Finding("readable", None, f"{recording.unchecked} blocks of it have no checksum")
    else:
        yield Finding("readable", True, f"{recording.count} messages, and every checksum is right")
    yield _check_statistics(recording, sequence)
    yield _check_closed(recording)
    yield _fault_finding("sequence", sequence.gaps, "the messages of every channel are numbered without a gap")
    yield _fault_finding("times", sequence.steps_back, "on every channel, messages are in the order of their times")


def _gap(written: ChannelMessage, expected: int) -> str:
    topic, number = written.message.topic, written.message.sequence
    if number < expected:
        return f"message {number} on {topic} comes after message {expected - 1}"
    if number == expected + 1:
        return f"message {expected} on {topic} is missing"
    return f"messages {expected} to {number - 1} on {topic} are missing"


def _fault_finding(name: str, faults: list[str], well: str) -> Finding:
    if not faults:
        return Finding(name, True, well)
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return Finding(name, False, faults[0] + more)


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
    return Finding("statistics", True, "the file has the messages, channels and times that it states")


def _check_closed(recording: Objective) -> Finding:
    closing = recording.metadata.get(CLOSED)
    if closing is None:
        return Finding("closed", False, "the recorder did not close it: the end may be missing")
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
        return Finding("closed", None, "the agent crashed and continued: the last second before may be missing")
    return Finding("closed", True, "the recorder closed it and had lost nothing")

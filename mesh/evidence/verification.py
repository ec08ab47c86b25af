"""Verifying a job: its two files against the claim, and the recording for completeness."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import msgspec

from mesh.evidence.claims import Finding, Verdict, check_about, check_end, check_signature, supplemented
from mesh.evidence.clock_checks import ClockCheck, RecorderParts
from mesh.evidence.playback import MessageDigest, check_played, digest_of
from mesh.evidence.recorder_checks import SequenceCheck, check_completeness, chosen_topics
from mesh.recording import GENEROUS, RecordingError, open_objective
from schemas import cid_of_file

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.content import Progress
    from mesh.evidence.claims import Claim
    from mesh.recording import Limits, Objective, Played


class RecordingObserver(Protocol):
    """Looks at a recording while it is verified, so that the file is read once for all.

    `open` is called first, `add` for each message in file order with the number of its part: a new part begins where
    the agent crashed and continued. `open_objective` is called last, unless the objective is not readable.
    """

    def open(self, recording: Objective) -> None:
        """Take the recording, whose messages follow."""

    def add(self, message: Played, part: int) -> None:
        """Take the next message."""

    def open_objective(self, objective: Objective) -> None:
        """Take the objective."""


def verify(
    claim: Claim,
    *,
    objective: Path,
    result: Path,
    message: bytes | None = None,
    objective_cid: str = "",
    result_cid: str = "",
    period: tuple[int, int] | None = None,
    limits: Limits = GENEROUS,
    observer: RecordingObserver | None = None,
    progress: Progress | None = None,
) -> Verdict:
    """Check everything that can be checked: the files behind the two CIDs, the signature, the recording.

    `message` is the encoded Result, if at hand. Pass the CIDs of files that were fetched by them: a CID made with other
    settings than ours can't be computed from the file. `period` is when the job was done, if that is known: from when
    to when, in nanoseconds of Unix time. Files beyond the `limits` are not readable. `observer` sees the messages of
    the recording. `progress` is called with the bytes of both files read, of all.

    Use a thread. Raises `OSError` if a file can't be read.
    """
    files = _JobFiles(objective, result, limits, progress)
    cids = objective_cid or cid_of_file(objective), result_cid or cid_of_file(result)
    return Verdict(tuple(_check_all(claim, files, message, *cids, period=period, observer=observer)))


class _JobFiles:
    """Opens the two files, each once, and calls `progress` for both together."""

    def __init__(self, objective: Path, result: Path, limits: Limits, progress: Progress | None) -> None:
        self._objective, self._result = objective, result
        self._limits = limits
        self._progress = progress
        self._sizes = result.stat().st_size, objective.stat().st_size

    def open_result(self) -> Objective:
        """The recording, the first to be opened. Raises `RecordingError`."""
        return self._open(self._result, before=0)

    def open_objective(self) -> Objective:
        """The objective, the second one. Raises `RecordingError`."""
        return self._open(self._objective, before=self._sizes[0])

    def _open(self, path: Path, *, before: int) -> Objective:
        tell, total = self._progress, sum(self._sizes)
        progress = None if tell is None else lambda done, _: tell(before + done, total)
        return open_objective(path, self._limits, progress=progress)


def _check_all(
    claim: Claim,
    files: _JobFiles,
    message: bytes | None,
    objective_cid: str,
    result_cid: str,
    *,
    period: tuple[int, int] | None,
    observer: RecordingObserver | None,
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
        recording = files.open_result()
    except RecordingError as error:
        yield Finding("readable", False, f"the recording is not readable: {error.why}")
        return
    played = _PlayedMessages()
    yield from _check_recording(claim, recording, played, period=period, observer=observer)
    try:
        objective = files.open_objective()
    except RecordingError as error:
        why = f"the objective is not a recording ({error.why})"
        if played.digests:
            yield Finding("played", False, f"messages were played, but {why}")
        else:
            yield Finding("played", None, f"nothing was played: {why}")
        return
    yield _check_playback(claim, recording, objective, played)
    if observer is not None:
        observer.open_objective(objective)


class _PlayedMessages:
    """The played messages of a recording, and the numbers of those before which the agent crashed and continued."""

    def __init__(self) -> None:
        self.digests: list[MessageDigest] = []
        self.seams: list[int] = []


def _check_recording(
    claim: Claim,
    recording: Objective,
    played: _PlayedMessages,
    *,
    period: tuple[int, int] | None,
    observer: RecordingObserver | None,
) -> Iterator[Finding]:
    if observer is not None:
        observer.open(recording)
    sequence, clock, part = SequenceCheck(), ClockCheck(RecorderParts.of(recording.metadata)), 0
    for written in recording.in_file_order():
        message = written.message
        sequence.add(written)
        if clock.add(message.log_time_ns) != part:
            part = clock.part
            played.seams.append(len(played.digests))
        if message.role == "objective":
            played.digests.append(digest_of(message))
        if observer is not None:
            observer.add(message, part)
    yield from check_completeness(recording, sequence)
    yield clock.finding()
    if period is not None:
        yield clock.period(*period)
    yield from check_about(claim, recording.metadata)


def _check_playback(claim: Claim, recording: Objective, objective: Objective, played: _PlayedMessages) -> Finding:
    chosen = chosen_topics(recording)
    due = [digest_of(message) for message in objective.messages() if not chosen or message.topic in chosen]
    finding = check_played(due, played.digests, seams=played.seams, complete=claim.success is not False)
    left_out = objective.count - len(due)
    if not left_out or finding.holds is False:
        return finding
    said = f"{finding.detail}; only {len(chosen)} topics were recorded, without {left_out} messages of the objective"
    return Finding(finding.name, None, said)


def _check_file(name: str, what: str, cid: str, claimed: str) -> Finding:
    if not claimed:
        return Finding(name, None, f"the {what} is {cid}, with nothing to compare it to")
    if cid != claimed:
        return Finding(name, False, f"the {what} is {cid}, and it should be {claimed}")
    return Finding(name, True, f"the {what} is {cid}")

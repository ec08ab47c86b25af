"""Judging a result: whether its recording proves that the work was done, by the policies of a validator.

Needs neither a chain nor a network. The recording is read once for all policies.
"""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

import msgspec

from mesh.base.log_context import log_event
from mesh.recording import GENEROUS, Limits
from mesh.validator.policies import CHECK_TIMEOUT, COMPLETE, Evidence
from mesh.validator.verification import (
    NOT_IN_BAGS,
    Claim,
    Finding,
    JobFiles,
    LegacyRecording,
    RecordingObserver,
    read_result,
    verify,
)
from schemas import cid_of_file
from schemas.signing import is_word
from schemas.verdicts import LONGEST_REPORT, LONGEST_TEXT, MOST_FINDINGS, ReportFinding

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from mesh.content import Progress
    from mesh.recording import Objective, Played
    from mesh.validator.policies import Policy, PolicyCheck
    from mesh.validator.verification import RecordedJob
    from schemas import Liability, Result
    from schemas.model import ModelDescription

log = logging.getLogger(__name__)

_LIMITS: Final = Limits()
_NOT_JUDGED: Final = frozenset({"finalized"})
"""Findings of `verify` that are not about the result: a validator judges before the contract has ended."""
_MAY_STAY_OPEN: Final = frozenset({"closed", CHECK_TIMEOUT})
"""Findings that may stay undecided: that an agent crashed, and may have lost a second of the recording, is no fault of
the robot, and neither is a check that takes too long."""
_INTERVAL: Final = struct.Struct("<Q")
_DISTINCT: Final = 8
"""Different times between messages without which a recording has no hash."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A Result to be judged.

    `message` is the promisor's encoded Result, which claims success if `claimed`. The recording must have been made
    between `since_ns` and `until_ns`, in nanoseconds of Unix time by the robot's clock: allow for wrong clocks.
    `owner_of` returns the address of another liability for which a recording with that mark (see `Judgement`) was
    judged a success; empty if there is none. `model` is the description of the liability's model, if it has one.

    Give the CIDs by which the files were fetched: one that was made with other settings than ours can't be computed.
    """

    liability: Liability
    claimed: bool
    message: bytes
    since_ns: int
    until_ns: int
    owner_of: Callable[[str], str]
    model: ModelDescription | None = None
    objective_cid: str = ""
    recording_cid: str = ""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Whether a result counts, and all that was found: the work counts only if it is claimed and every finding holds.

    If an own check took too long and nothing else fails, the result is not judged: `is_decided` is false.

    `marks` identify the recording, so that it pays only one job: the CID of the file, and a hash of the times between
    its messages, to the nanosecond, which stays if names, values and the time of day are changed. A recording with few
    messages has no hash, as another one might have the same.
    """

    success: bool
    findings: tuple[ReportFinding, ...]
    marks: tuple[str, ...] = ()

    @property
    def failures(self) -> tuple[ReportFinding, ...]:
        """The findings because of which the work does not count."""
        return tuple(finding for finding in self.findings if finding.holds is False)

    @property
    def overdue(self) -> tuple[str, ...]:
        """The policies whose checks took too long."""
        return tuple(one.policy for one in self.findings if one.code == CHECK_TIMEOUT and one.holds is None)

    @property
    def is_decided(self) -> bool:
        """Whether a verdict can be signed."""
        return self.success or bool(self.failures)


def judge(
    case: Case,
    *,
    objective: Path,
    recording: Path,
    policies: Sequence[Policy],
    bags: bool = False,
    limits: Limits = _LIMITS,
) -> Judgement:
    """Judge a result by `complete` and the `policies`. Files beyond the `limits` are not readable.

    With `bags` the recording may be a bag of the legacy software, of which less can be checked.

    Use a thread. Raises `OSError` if a file can't be read; whatever is in the files is a finding.
    """
    trial = _Trial(case.liability, case.model, policies)
    cid = case.recording_cid or cid_of_file(recording)
    signed = read_result(case.message)
    claimed = None if isinstance(signed, str) else signed.message
    claim = Claim.of_contract(case.liability)
    complete, own = trial.run(
        msgspec.structs.replace(claim, result=claimed.result if claimed else "", success=case.claimed, finalized=None),
        JobFiles(
            objective=objective,
            result=recording,
            message=case.message,
            objective_cid=case.objective_cid,
            result_cid=cid,
            period=(case.since_ns, case.until_ns),
        ),
        bags=bags,
        limits=limits,
    )
    found = [_check_claimed(case, claimed)]
    found += [one if trial.is_legacy and one.name in NOT_IN_BAGS else _decided(one) for one in complete]
    marks = trial.marks(cid)
    found.append(_check_replayed(case, marks))
    reported = [_reported(COMPLETE.name, finding) for finding in found]
    reported += [_reported(policy, _decided(finding)) for policy, finding in own]
    holds = all(one.holds is not False and (one.code != CHECK_TIMEOUT or one.holds) for one in reported)
    return Judgement(success=case.claimed and holds, findings=_bounded(reported), marks=marks)


def examine(
    liability: Liability,
    files: JobFiles,
    *,
    policies: Sequence[Policy],
    model: ModelDescription | None = None,
    bags: bool = False,
    progress: Progress | None = None,
) -> tuple[ReportFinding, ...]:
    """What a validator would find in a recording that nobody has handed in: `aira validator check`.

    The `liability` is what own checks get. Findings for which there is nothing to compare with stay undecided. Use a
    thread. Raises `OSError` if a file can't be read.
    """
    trial = _Trial(liability, model, policies)
    complete, own = trial.run(Claim(), files, bags=bags, progress=progress)
    found = [*((COMPLETE.name, finding) for finding in complete), *own]
    return tuple(_reported(policy, finding) for policy, finding in found)


class _Trial(RecordingObserver):
    """Shows the recording to all policies while it is verified, and computes its hash."""

    def __init__(self, liability: Liability, model: ModelDescription | None, policies: Sequence[Policy]) -> None:
        self._evidence = Evidence(liability, model=model, keep=any(policy.is_own for policy in policies))
        self._policies = policies
        self._checks: list[PolicyCheck] = []
        self._hash = blake2b(digest_size=32)
        self._intervals: set[int] = set()
        self._last = 0
        self.is_legacy = False
        """Whether it is a bag of the legacy software, in which most findings of `verify` stay undecided."""

    def run(
        self, claim: Claim, files: JobFiles, *, bags: bool, limits: Limits = GENEROUS, progress: Progress | None = None
    ) -> tuple[list[Finding], list[tuple[str, Finding]]]:
        """What `verify` and then the policies find in the files.

        A recording that they can't deal with proves nothing, which is a finding: if it raised an error, its maker
        could keep the validator from judging. Raises `OSError` if a file can't be read.
        """
        try:
            verdict = verify(claim, files, bags=bags, limits=limits, observer=self, progress=progress)
            found = [one for one in verdict.findings if one.name not in _NOT_JUDGED]
            # Without a readable recording no check was begun.
            pairs = zip(self._policies, self._checks, strict=False)
            return found, [(policy.name, one) for policy, check in pairs for one in check.findings()]
        except OSError:
            raise
        except Exception as error:
            log.exception("a recording can't be judged", extra=log_event("judging-impossible"))
            return [Finding("readable", False, f"the recording can't be judged ({type(error).__name__})")], []

    def open(self, recording: RecordedJob) -> None:
        self.is_legacy = isinstance(recording, LegacyRecording)
        self._evidence.open(recording)
        self._checks = [policy.begin(self._evidence) for policy in self._policies]
        self._last = recording.start_ns

    def add(self, message: Played, part: int) -> None:
        judged = self._evidence.add(message, part)
        for check in self._checks:
            check.add(judged)
        since, self._last = message.log_time_ns - self._last, message.log_time_ns
        self._hash.update(_INTERVAL.pack(since % (1 << 64)))
        if len(self._intervals) < _DISTINCT:
            self._intervals.add(since)

    def open_objective(self, objective: Objective) -> None:
        self._evidence.open_objective(objective)

    def marks(self, cid: str) -> tuple[str, ...]:
        return (cid, self._hash.hexdigest()) if len(self._intervals) == _DISTINCT else (cid,)


def _check_claimed(case: Case, signed: Result | None) -> Finding:
    if not case.claimed:
        return Finding("claimed", False, "the promisor does not claim success")
    if signed is not None and not signed.success:
        return Finding("claimed", False, "the promisor has signed that it had no success")
    return Finding("claimed", True, "the promisor claims success")


def _check_replayed(case: Case, marks: Sequence[str]) -> Finding:
    for mark in marks:
        if owner := case.owner_of(mark):
            return Finding("replayed", False, f"these messages were the result of another liability, {owner}")
    return Finding("replayed", True, "no other liability had these messages as its result")


def _decided(finding: Finding) -> Finding:
    """The finding, as a failure if it is undecided and must not be."""
    if finding.holds is None and finding.name not in _MAY_STAY_OPEN:
        return Finding(finding.name, False, finding.detail)
    return finding


def _reported(policy: str, finding: Finding) -> ReportFinding:
    """A finding for the report. Its texts may be those of strangers, or of a user's check."""
    code = finding.name if is_word(finding.name) else "check"
    return ReportFinding(policy=policy, code=code, holds=finding.holds, detail=_line(str(finding.detail)))


def _line(text: str) -> str:
    """At most `LONGEST_TEXT` characters of a text that a terminal shows as they are."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text[: LONGEST_TEXT + 1])
    return shown if len(shown) <= LONGEST_TEXT else shown[: LONGEST_TEXT - 1] + "…"


def _bounded(findings: Sequence[ReportFinding]) -> tuple[ReportFinding, ...]:
    """As many findings as a report holds, in their order; failures come before others if there are too many."""
    kept, size = set[int](), 0
    for number in sorted(range(len(findings)), key=lambda number: findings[number].holds is not False):
        size += len(findings[number].encode()) + 1
        if len(kept) < MOST_FINDINGS and size <= LONGEST_REPORT - 4096:  # for the rest of the report
            kept.add(number)
    return tuple(finding for number, finding in enumerate(findings) if number in kept)

"""What validators publish: what they judge by, and how they judged a result.

A validator is what a liability names as such: in generation 5 a contract, of which several accounts (jurors) may be
the judges; in generation 3 an account that judges itself.
"""

from __future__ import annotations

from typing import ClassVar, Final, NamedTuple

from schemas.cid import parse_cid
from schemas.errors import InvalidCid, InvalidRecord
from schemas.records import Record, UInt256, check_addresses
from schemas.signing import SignedRecord, is_word


class VerdictLimits(NamedTuple):
    """What an announcement or a report may have."""

    size: int = 16_384
    """Bytes of it as it is encoded; receivers refuse more."""
    policies: int = 16
    """Policies of one announcement."""
    findings: int = 32
    """Findings of one report."""
    text: int = 300
    """Characters of a title, of a description and of a finding's detail."""


VERDICT_LIMITS: Final = VerdictLimits()


class PolicyNote(Record, frozen=True, kw_only=True):
    """A policy as its validator announces it: a name for programs (a word), and what it demands, for people."""

    name: str
    description: str

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        _check_word(self, "name", self.name)
        _check_text(self, "description", self.description)


class ValidatorAnnouncement(SignedRecord, frozen=True, kw_only=True):
    """How a validator judges, and for what fee; each of its jurors answers queries of `ValidatorKey` with one.

    `validator` and `juror` are EIP-55 addresses; in generation 3 they are equal. A result needs the signatures of
    `quorum` of the contract's `jurors`, and `fee` is what a demand should pay for that, in wn. `made_at` is the
    juror's time of day, in seconds. Trust it only if it `is_signed` and the validator accepts the juror.
    """

    domain: ClassVar = b"aira validator\0"
    author: ClassVar = "juror"

    validator: str
    juror: str
    title: str
    policies: tuple[PolicyNote, ...]
    fee: UInt256
    quorum: int
    jurors: int
    made_at: int

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        check_addresses(self, "validator", "juror")
        _check_text(self, "title", self.title)
        _check_count(self, "policies", len(self.policies), VERDICT_LIMITS.policies)
        if not 1 <= self.quorum <= self.jurors <= 255:
            raise InvalidRecord("ValidatorAnnouncement", "quorum: expected 1 to the number of jurors, at most 255")


class ReportFinding(Record, frozen=True, kw_only=True):
    """The outcome of one check: `policy` and `code` are words, `detail` is for people.

    `holds` is None if the check could not decide; that counts as a failure only where its policy says so.
    """

    policy: str
    code: str
    holds: bool | None
    detail: str

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        _check_word(self, "policy", self.policy)
        _check_word(self, "code", self.code)
        _check_text(self, "detail", self.detail)


class ValidatorReport(SignedRecord, frozen=True, kw_only=True):
    """How a juror judged the result of a liability; a file of its encoded bytes has its CID.

    It is put on `ReportKey` for both parties. `claimed` is the success that the promisor has signed, `success` what the
    juror has signed: true only if both the promisor and the juror say so. `result` and `objective` are CIDs,
    `judged_at` is the juror's time of day in seconds. Trust it only if it `is_signed` and the validator accepts the
    juror.
    """

    domain: ClassVar = b"aira report\0"
    author: ClassVar = "juror"

    liability: str
    objective: str
    result: str
    validator: str
    juror: str
    claimed: bool
    success: bool
    findings: tuple[ReportFinding, ...]
    judged_at: int

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        check_addresses(self, "liability", "validator", "juror")
        for field in ("objective", "result"):
            try:
                parse_cid(getattr(self, field))
            except InvalidCid as error:
                raise InvalidRecord("ValidatorReport", f"{field}: {error}") from None
        if self.success and not self.claimed:
            raise InvalidRecord("ValidatorReport", "success: the promisor claims none")
        _check_count(self, "findings", len(self.findings), VERDICT_LIMITS.findings)

    @property
    def failures(self) -> tuple[ReportFinding, ...]:
        """The findings because of which the work does not count."""
        return tuple(finding for finding in self.findings if finding.holds is False)


def _check_word(record: Record, field: str, text: str) -> None:
    if not is_word(text):
        raise InvalidRecord(type(record).__name__, f"{field}: expected words of letters and digits, with hyphens")


def _check_text(record: Record, field: str, text: str) -> None:
    if len(text) > VERDICT_LIMITS.text:
        raise InvalidRecord(type(record).__name__, f"{field}: expected at most {VERDICT_LIMITS.text} characters")


def _check_count(record: Record, field: str, count: int, most: int) -> None:
    if count > most:
        raise InvalidRecord(type(record).__name__, f"{field}: expected at most {most}, not {count}")

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from schemas import InvalidRecord, Signer
from schemas.verdicts import (
    VERDICT_LIMITS,
    PolicyNote,
    ReportFinding,
    ValidatorAnnouncement,
    ValidatorReport,
)

JUROR = Signer(bytes(31) + b"\x07")
OTHER = Signer(bytes(31) + b"\x08")
CID = "QmfCcLKrTCuXsf6bHbVupVv4zsbs6kjqTQ7DRftGqMLjdW"
FINDING = ReportFinding(policy="complete", code="played", holds=True, detail="all 3 messages were played")
ANNOUNCED = ValidatorAnnouncement(
    validator=OTHER.address,
    juror=JUROR.address,
    title="Lamps",
    policies=(PolicyNote(name="complete", description="everything was played"),),
    fee=1000,
    quorum=1,
    jurors=1,
    made_at=1_700_000_000,
)
REPORT = ValidatorReport(
    liability=OTHER.address,
    objective=CID,
    result=CID,
    validator=OTHER.address,
    juror=JUROR.address,
    claimed=True,
    success=True,
    findings=(FINDING,),
    judged_at=1_700_000_000,
)


@pytest.mark.parametrize("record", [ANNOUNCED, REPORT], ids=lambda record: type(record).__name__)
def test_signature_is_the_jurors(record: Any) -> None:
    signed = record.signed_by(JUROR)
    assert type(record).decode(signed.encode()).is_signed
    assert not record.is_signed
    assert not record.signed_by(OTHER).is_signed
    assert not replace(signed, juror=OTHER.address).is_signed


def test_signature_covers_every_field() -> None:
    signed = REPORT.signed_by(JUROR)
    for changed in (replace(signed, success=False), replace(signed, findings=()), replace(signed, judged_at=1)):
        assert not changed.is_signed


@pytest.mark.parametrize(
    "changes",
    [
        {"liability": "0x00"},
        {"juror": JUROR.address.lower()},
        {"result": "Qm"},
        {"claimed": False},
        {"findings": (FINDING,) * (VERDICT_LIMITS.findings + 1)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_invalid_reports(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidRecord):
        replace(REPORT, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"quorum": 0},
        {"quorum": 2},
        {"jurors": 256},
        {"fee": -1},
        {"title": "x" * (VERDICT_LIMITS.text + 1)},
        {"policies": ANNOUNCED.policies * (VERDICT_LIMITS.policies + 1)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_invalid_announcements(changes: dict[str, Any]) -> None:
    with pytest.raises(InvalidRecord):
        replace(ANNOUNCED, **changes)


@pytest.mark.parametrize(("field", "text"), [("policy", "Not A Word"), ("code", ""), ("detail", "x" * 301)])
def test_invalid_findings(field: str, text: str) -> None:
    with pytest.raises(InvalidRecord):
        replace(FINDING, **{field: text})


def test_largest_report_fits_its_limit() -> None:
    finding = replace(FINDING, policy="a" * 64, code="b" * 64, detail="x" * VERDICT_LIMITS.text)
    report = replace(REPORT, findings=(finding,) * VERDICT_LIMITS.findings)
    assert len(report.signed_by(JUROR).encode()) <= VERDICT_LIMITS.size


def test_failures() -> None:
    failed = replace(FINDING, holds=False)
    report = replace(REPORT, success=False, findings=(FINDING, failed, replace(FINDING, holds=None)))
    assert report.failures == (failed,)

"""What a Result and two files prove without a chain."""

from __future__ import annotations

import pytest

from mesh.validator.verification import Claim
from schemas import ZERO_ADDRESS, Demand, cid_of_bytes, encode
from tests.support.validator.jobs import OTHER, ROBOT, THIEF, SampleJob, failures


def test_a_result_message_proves_who_signed_it(job: SampleJob) -> None:
    verdict = job.verify(job.message(), finalized=None)
    assert verdict.holds
    signature = verdict.of("signature")
    assert signature is not None
    assert (signature.holds, ROBOT.address in signature.detail) == (True, True)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"signer": THIEF}, f"{THIEF.address} signed it, and the promisor is {ROBOT.address}"),
        ({"liability": OTHER}, "for another liability"),
        ({"result": cid_of_bytes(b"another")}, "for another recording"),
    ],
)
def test_a_result_message_with_another_signer_liability_or_recording_fails(
    job: SampleJob, fields: dict[str, object], why: str
) -> None:
    said = failures(job.verify(job.message(**fields)))  # type: ignore[arg-type]
    assert set(said) == {"signature"}
    assert why in said["signature"]


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff", b'{"liability": 1}'])
def test_an_undecodable_result_message_fails(job: SampleJob, content: bytes) -> None:
    assert failures(job.verify(content))["signature"].startswith("the Result message: ")


def test_a_demand_is_not_a_result(job: SampleJob) -> None:
    demand = Demand(
        model=cid_of_bytes(b"m"),
        objective=cid_of_bytes(b"o"),
        token=OTHER,
        cost=1,
        lighthouse=OTHER,
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=1,
        nonce="0" * 64,
    )
    assert "not a Result" in failures(job.verify(encode(ROBOT.sign(demand))))["signature"]


def test_two_files_alone_leave_the_other_findings_open(job: SampleJob) -> None:
    job.claim = Claim()
    verdict = job.verify()
    assert verdict.holds
    undecided = {finding.name for finding in verdict.findings if finding.holds is None}
    assert undecided == {"finalized", "signature", "result-file", "objective-file", "liability", "agent", "lighthouse"}


def test_an_arbiter_needs_no_chain_with_the_result_message(job: SampleJob) -> None:
    job.claim = Claim()
    verdict = job.verify(job.message())
    assert verdict.holds
    undecided = {finding.name for finding in verdict.findings if finding.holds is None}
    assert undecided == {"finalized", "objective-file", "lighthouse"}

"""What the assertions of `mesh.testing` say when they fail."""

from __future__ import annotations

import pytest

from mesh import Agent, Declined, DemandDeclined, Job, JobFailed, Outcome
from mesh.testing import FakeJob, assert_declined, assert_paid, assert_refunded, run
from schemas.signing import Decline

PAID = Outcome(success=True, result="Qm")
REFUNDED = Outcome(success=False, result="Qm", reason="the battery is empty", code="battery-empty")


def declined(code: str, detail: str) -> DemandDeclined:
    robot = "0x00000000000000000000000000000000000000A1"
    return DemandDeclined("00" * 32, [Decline(agent=robot, order="00" * 32, code=code, detail=detail)])


def test_a_paid_job_is_paid_and_not_refunded() -> None:
    assert_paid(PAID)
    with pytest.raises(AssertionError, match=r"expected a refund with the code battery-empty, but the robot was paid"):
        assert_refunded(PAID, code="battery-empty")


def test_a_refunded_job_says_why_it_was_not_paid() -> None:
    assert_refunded(REFUNDED)
    assert_refunded(REFUNDED, code="battery-empty")
    with pytest.raises(AssertionError, match=r"not paid: the battery is empty \[battery-empty\]"):
        assert_paid(REFUNDED)
    with pytest.raises(AssertionError, match=r"code stopped, but .*: the battery is empty \[battery-empty\]"):
        assert_refunded(REFUNDED, code="stopped")


async def test_what_was_published_is_shown() -> None:
    robot = Agent()

    @robot.on("/lift")
    async def lift(job: Job, metres: float) -> None:
        job.publish("/height", 0.25)
        raise JobFailed("too heavy")

    outcome = await run(robot, FakeJob([("/lift", 1.5)]))
    with pytest.raises(AssertionError, match=r"(?s)too heavy \[job-failed\].*/height 0\.25"):
        assert_paid(outcome)


def test_a_decline_is_told_from_others() -> None:
    assert_declined(Declined("too-cheap", "that costs 3 XRT"), code="too-cheap")
    assert_declined(declined("too-cheap", "that costs 3 XRT"))
    with pytest.raises(AssertionError, match=r"code closed, but the robots said: too-cheap \(that costs 3 XRT\)"):
        assert_declined(declined("too-cheap", "that costs 3 XRT"), code="closed")
    with pytest.raises(AssertionError, match="expected that a robot declines, but it is ValueError: no"):
        assert_declined(ValueError("no"))

"""What a validator would say of a job."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.testing._fake_job import CONTRACT, ROBOT
from mesh.validator.policies import COMPLETE, Evidence
from schemas import Liability

if TYPE_CHECKING:
    from mesh.testing._outcomes import RecordedOutcome
    from mesh.validator.validator import Validator


def judge(validator: Validator, outcome: RecordedOutcome) -> list[str]:
    """Why a validator would not let a job count, by its own checks and by the shipped policies but `complete`.

    It is empty if they hold. The validator need not run; `outcome` is what `run` and `Market.order` return.
    """
    messages = outcome.recording.messages
    evidence = Evidence(Liability.of_nobody(address=CONTRACT, promisor=ROBOT), keep=True)
    evidence._start_ns = min((message.log_time_ns for message in messages), default=0)
    checks = [policy.begin(evidence) for policy in validator.policies if policy != COMPLETE]
    for message in messages:
        judged = evidence.add(message, 0)
        for check in checks:
            check.add(judged)
    return [found.detail or found.name for check in checks for found in check.findings() if found.holds is not True]

"""Results to be judged: a job's two files with the case about them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mesh.validator.judging import Case, Judgement, judge
from schemas import Liability, cid_of_bytes
from tests.support.validator.jobs import OTHER, SampleJob

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.validator.judging import Policy

ALWAYS = (0, 1 << 63)


def liability_of(job: SampleJob) -> Liability:
    """The contract of a job, which has not ended."""
    return Liability.of_nobody(
        address=job.claim.liability,
        model=cid_of_bytes(b"model"),
        objective=job.claim.objective,
        promisee=OTHER,
        promisor=job.claim.promisor,
        lighthouse=job.claim.lighthouse,
        cost=1,
        validator=OTHER,
    )


@dataclass
class Trial:
    """Judges the result of a job as a juror does, which remembers what it has judged."""

    job: SampleJob
    judged: dict[str, str] = field(default_factory=dict)

    def judge(self, *policies: Policy, **changed: Any) -> Judgement:
        """Judge the result by these policies, with these fields of the case changed."""
        given: dict[str, Any] = {
            "liability": liability_of(self.job),
            "claimed": True,
            "message": self.job.message(),
            "since_ns": ALWAYS[0],
            "until_ns": ALWAYS[1],
            "owner_of": lambda mark: self.judged.get(mark, ""),
        }
        return judge(
            Case(**given | changed), objective=self.job.objective, recording=self.job.result, policies=policies
        )


def failed(judgement: Judgement) -> dict[str, str]:
    """The failures by `policy/code`, with their details."""
    return {f"{finding.policy}/{finding.code}": finding.detail for finding in judgement.failures}


def names(policies: Sequence[Policy]) -> list[str]:
    """The names of policies."""
    return [policy.name for policy in policies]

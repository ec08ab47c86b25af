"""A result that legacy software recorded counts where bags are accepted, and only if it shows the job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.validator.judging import Case, Judgement, examine, judge, policy_of
from mesh.validator.verification import Claim, JobFiles
from schemas import cid_of_file, parse_address
from tests.mesh.validator.test_legacy import DUE, JOB, OTHER, bag, below
from tests.support.validator.jobs import ROBOT, SampleJob
from tests.support.validator.trials import ALWAYS, failed, liability_of

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.validator.judging import Policy

ANSWERED = [*below(DUE), *below([("/blinked", "red")])]


def judged(
    folder: Path, recorded: list[tuple[str, str]], *policies: Policy, bags: bool = True, **changed: Any
) -> Judgement:
    """Judge a job with the objective `DUE` whose result is a bag with these messages."""
    objective, result = bag(folder / "objective.bag", DUE), bag(folder / "result.bag", recorded)
    claim = Claim(
        liability=parse_address(JOB),
        promisor=ROBOT.address,
        lighthouse=parse_address(OTHER),
        objective=cid_of_file(objective),
        result=cid_of_file(result),
    )
    job = SampleJob(objective, result, claim)
    given: dict[str, Any] = {
        "liability": liability_of(job),
        "claimed": True,
        "message": job.message(liability=claim.liability),
        "since_ns": ALWAYS[0],
        "until_ns": ALWAYS[1],
        "owner_of": lambda _: "",
    }
    case = Case(**given | changed)
    return judge(case, objective=objective, recording=result, policies=policies, bags=bags)


def test_a_bag_counts_where_bags_are_accepted(tmp_path: Path) -> None:
    judgement = judged(tmp_path, ANSWERED, policy_of("acknowledged:command=/blink:answer=/blinked:within=1h"))
    assert failed(judgement) == {"acknowledged/answers": failed(judgement)["acknowledged/answers"]}
    judgement = judged(tmp_path, ANSWERED, policy_of("acknowledged:command=/move:answer=/blinked"))
    assert failed(judgement) == {}
    assert judgement.success


def test_a_bag_is_refused_elsewhere(tmp_path: Path) -> None:
    assert {"complete/statistics", "complete/closed"} & failed(judged(tmp_path, ANSWERED, bags=False)).keys()


@pytest.mark.parametrize(
    ("recorded", "code"),
    [
        (below(DUE[:2]), "complete/played"),
        (DUE, "complete/liability"),
        (below(DUE, OTHER), "complete/liability"),
    ],
)
def test_a_bag_that_does_not_show_the_job_does_not_count(
    tmp_path: Path, recorded: list[tuple[str, str]], code: str
) -> None:
    judgement = judged(tmp_path, recorded)
    assert not judgement.success
    assert code in failed(judgement)


@pytest.mark.parametrize(("bound", "time"), [("since_ns", 2), ("until_ns", 3)])
def test_a_bag_from_another_time_does_not_count(tmp_path: Path, bound: str, time: int) -> None:
    changed: dict[str, Any] = {bound: time}
    assert set(failed(judged(tmp_path, ANSWERED, **changed))) == {"complete/period"}


def test_a_bag_that_another_one_signed_does_not_count(tmp_path: Path) -> None:
    assert set(failed(judged(tmp_path, ANSWERED, message=b"{}"))) == {
        "complete/signature",
        "complete/result-file",
    }


def test_a_bag_is_checked_by_hand(tmp_path: Path) -> None:
    judgement = judged(tmp_path, ANSWERED)
    assert judgement.success
    liability = msgspec.structs.replace(liability_of(SampleJob(tmp_path, tmp_path, Claim())), address=JOB)
    objective, recording = tmp_path / "objective.bag", tmp_path / "result.bag"
    findings = examine(liability, JobFiles(objective=objective, result=recording), policies=(), bags=True)
    found = {one.code: one.holds for one in findings}
    assert found["played"]
    assert False not in found.values()

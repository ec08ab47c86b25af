"""A result counts if it is claimed, and if every policy finds that its recording proves it."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from mesh import ConfigurationError
from mesh.recording import open_objective
from mesh.validator.judging import JUDGING_LIMITS, POLICIES, Evidence, Policy, judge, own_policy, policy_of
from mesh.validator.verification import Finding
from schemas.verdicts import VERDICT_LIMITS
from tests.support.raising import raises_with
from tests.support.validator.jobs import OTHER, THIEF, WORDS, make_job
from tests.support.validator.trials import Trial, failed, liability_of
from tests.support.waiting import wait_until


@pytest.fixture
def trial(tmp_path: Path) -> Trial:
    return Trial(make_job(tmp_path))


def test_an_honest_result_counts_by_every_shipped_policy(trial: Trial) -> None:
    judgement = trial.judge(policy_of("acknowledged:command=/say:answer=/said"), POLICIES["schema"], POLICIES["rate"])
    assert failed(judgement) == {}
    assert judgement.success
    assert {finding.policy for finding in judgement.findings} == set(POLICIES)


def test_a_result_whose_promisor_claims_no_success_does_not_count(trial: Trial) -> None:
    assert set(failed(trial.judge(claimed=False))) == {"complete/claimed"}
    signed = trial.judge(message=trial.job.message(success=False))
    assert (signed.success, set(failed(signed))) == (False, {"complete/claimed"})


@pytest.mark.parametrize(
    ("message", "code"),
    [({"signer": THIEF}, "signature"), ({"liability": OTHER}, "signature"), (None, "signature")],
)
def test_a_result_that_another_one_signed_does_not_count(
    trial: Trial, message: dict[str, Any] | None, code: str
) -> None:
    judgement = trial.judge(message=b"{}" if message is None else trial.job.message(**message))
    assert not judgement.success
    assert f"complete/{code}" in failed(judgement)


def test_a_recording_from_before_or_after_the_job_does_not_count(trial: Trial) -> None:
    start = open_objective(trial.job.result).start_ns
    assert "begins before the job" in failed(trial.judge(since_ns=start + 1))["complete/period"]
    assert "ends after its result" in failed(trial.judge(until_ns=start))["complete/period"]
    assert trial.judge(since_ns=start - 10**9, until_ns=start + 10**12).success


def test_a_recording_pays_one_job_only(trial: Trial) -> None:
    first = trial.judge()
    assert first.success
    for mark in first.marks:
        trial.judged = {mark: OTHER}
        assert f"the result of another liability, {OTHER}" in failed(trial.judge())["complete/replayed"]


def test_an_unreadable_recording_is_a_finding(trial: Trial) -> None:
    trial.job.result.write_bytes(b"nonsense")
    judgement = trial.judge(*POLICIES.values())
    assert set(failed(judgement)) == {"complete/readable"}


def test_log_times_at_both_ends_of_their_range_are_judged(trial: Trial) -> None:
    damaged = Path(__file__).parents[1] / "recording" / "damaged"
    trial.job.result.unlink()
    shutil.copy(damaged / "huge_time.mcap", trial.job.result)
    judgement = trial.judge(*POLICIES.values())
    assert (judgement.success, judgement.is_decided) == (False, True)
    assert "complete/times" in failed(judgement)


def test_a_recording_that_raises_an_error_while_it_is_judged_does_not_count(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Evidence, "add", lambda *_: 1 // 0)
    judgement = trial.judge()
    assert (judgement.success, judgement.is_decided) == (False, True)
    assert "ZeroDivisionError" in failed(judgement)["complete/readable"]


def test_a_command_without_an_answer_in_time_does_not_count(tmp_path: Path) -> None:
    trial = Trial(make_job(tmp_path, topics="/say,/stop"))
    judgement = trial.judge(POLICIES["acknowledged"])
    assert set(failed(judgement)) == {"acknowledged/answers", "complete/played"}
    assert "5 of 5 commands" in failed(judgement)["acknowledged/answers"]


def test_the_last_command_needs_an_answer_too(trial: Trial) -> None:
    """`/stop` has none, unless only commands on `/say` need one."""
    assert "1 of 6 commands" in failed(trial.judge(POLICIES["acknowledged"]))["acknowledged/answers"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("rate:topic=/lidar", "rate/rate"),
        ("rate:topic=/said:min=100", "rate/rate"),
        ("rate:topic=/said:max=0.5", "rate/rate"),
    ],
)
def test_a_topic_with_the_wrong_rate_does_not_count(trial: Trial, text: str, found: str) -> None:
    assert set(failed(trial.judge(policy_of(text)))) == {found}


@pytest.mark.parametrize(
    "text",
    ["nonsense", "rate:min=x", "rate:min=2:max=1", "rate:most=1", "rate:gap=5", "complete:a=b", "rate:min=1:min=2"],
)
def test_a_policy_that_can_not_be_read_is_refused(text: str) -> None:
    with raises_with(ConfigurationError, code="invalid-policy"):
        policy_of(text)


def own(function: Any) -> Policy:
    return own_policy("own", "All words are said.", function)


def says_all(evidence: Evidence) -> bool:
    said = [message.value for message in evidence.device.on("/said")]
    due = [message.value for message in evidence.objective.on("/say")]
    assert [message.value for message in evidence.played.on("/say")] == due
    assert next(iter(evidence.messages)).time == 0
    return said == list(WORDS) == due


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (says_all, {}),
        (lambda evidence: "", {}),
        (lambda evidence: [], {}),
        (lambda evidence: False, {"own/check": "it does not hold: All words are said."}),
        (lambda evidence: None, {"own/check": "the check did not decide"}),
        (lambda evidence: "too quiet", {"own/check": "too quiet"}),
        (lambda evidence: [Finding("loud", True, "yes"), Finding("clear", False, "no")], {"own/clear": "no"}),
        (lambda evidence: (f"word {number}" for number in range(10**9)), None),
        (lambda evidence: evidence.nonsense, {"own/check-failed": None}),
        (lambda evidence: [1 / 0], {"own/check-failed": "ZeroDivisionError: division by zero"}),
        (lambda evidence: Finding("Not A Word", False, "x\n" * 400), {"own/check": None}),
    ],
)
def test_a_function_of_a_user_is_a_policy(trial: Trial, function: Any, expected: dict[str, str | None] | None) -> None:
    judgement = trial.judge(own(function))
    assert len(judgement.findings) <= VERDICT_LIMITS.findings
    assert judgement.success is (expected == {})
    if expected is not None:
        assert set(failed(judgement)) == set(expected)
        for code, detail in expected.items():
            assert detail is None or failed(judgement)[code] == detail


def test_messages_beyond_the_memory_for_own_policies_are_read_again(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mesh.validator.judging.JUDGING_LIMITS", JUDGING_LIMITS._replace(kept=1000))
    assert trial.judge(own(says_all)).success


def test_files_beyond_the_limits_do_not_count(trial: Trial) -> None:
    from mesh.recording import Limits
    from mesh.validator.judging import Case

    case = Case(
        liability=liability_of(trial.job),
        claimed=True,
        message=trial.job.message(),
        since_ns=0,
        until_ns=1 << 63,
        owner_of=lambda mark: "",
    )
    files: dict[str, Any] = {"objective": trial.job.objective, "recording": trial.job.result}
    judgement = judge(case, **files, policies=(), limits=Limits(messages=5))
    assert set(failed(judgement)) == {"complete/readable"}


def test_a_check_that_takes_too_long_decides_nothing(trial: Trial) -> None:
    end = threading.Event()
    overdue = own_policy("own", "It ends.", lambda evidence: end.wait(), 0.05)
    try:
        judgement = trial.judge(overdue)
        # What fails for another reason fails all the same.
        failing = trial.judge(overdue, own(lambda evidence: False))
    finally:
        end.set()
    assert (judgement.success, judgement.is_decided, judgement.overdue) == (False, False, ("own",))
    assert [one.detail for one in judgement.findings if one.code == "check-timeout"] == ["it did not end within 0.05 s"]
    assert (failing.success, failing.is_decided) == (False, True)
    wait_until(lambda: not checking(), what="the end of the checks")


def test_checks_that_never_end_are_bounded(trial: Trial) -> None:
    end = threading.Event()
    stuck = own_policy("own", "It ends.", lambda evidence: end.wait(), 0.02)
    try:
        details = [trial.judge(stuck).findings[-1].detail for _ in range(JUDGING_LIMITS.overdue + 1)]
        assert len(checking()) == JUDGING_LIMITS.overdue
        assert details[-1] == f"it was not begun: {JUDGING_LIMITS.overdue} earlier checks have not ended"
    finally:
        end.set()
    wait_until(lambda: not checking(), what="the end of the checks")
    assert trial.judge(own(says_all)).success


def checking() -> list[threading.Thread]:
    """The threads of own checks."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("check ")]


@pytest.mark.parametrize("timeout", [0, -1, float("nan"), float("inf")])
def test_the_time_of_a_check_is_a_positive_number(timeout: float) -> None:
    with raises_with(ConfigurationError, code="invalid-policy"):
        own_policy("own", "It ends.", says_all, timeout)

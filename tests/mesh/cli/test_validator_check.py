"""`aira validator check`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from mesh.cli import main
from tests.support.validator.jobs import WORDS, SampleJob, make_job

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result

PROGRAM = """
from mesh import Validator

validator = Validator(policies=["acknowledged:command=/say:answer=/said"])


@validator.check("loud", description="Every answer is loud.")
def loud(evidence):
    for message in evidence.device.on("/said"):
        if not message.value.isupper():
            yield f"{message.value} at {message.time:.0f} s is not loud"


validator.run()
"""


@pytest.fixture
def job(tmp_path: Path) -> SampleJob:
    return make_job(tmp_path)


def checked(job: SampleJob, *more: str | Path) -> Result:
    words = ["validator", "check", job.result, "--objective", job.objective, "--data-dir", job.result.parent / "data"]
    return CliRunner().invoke(main, [str(word) for word in [*words, *more]])


def test_an_honest_recording_holds_by_the_default_policies(job: SampleJob) -> None:
    done = checked(job)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert any(line.startswith("holds") and "complete/played" in line for line in lines)
    assert any(line.startswith("open") and "complete/signature" in line for line in lines)
    assert lines[-1].startswith("0 of 16 checks failed")


def test_each_policy_that_is_named_is_applied_and_a_failure_is_exit_code_1(job: SampleJob) -> None:
    done = checked(job, "--policy", "acknowledged:answer=/nobody", "--policy", "schema")
    assert done.exit_code == 1
    assert "FAILS  acknowledged/answers" in done.stdout
    assert "holds  schema/types" in done.stdout


def test_a_recording_that_is_cut_fails_and_without_an_objective_can_not_be_checked(job: SampleJob) -> None:
    job.result.write_bytes(job.result.read_bytes()[:900])
    done = checked(job)
    assert (done.exit_code, "FAILS  complete/readable" in done.stdout) == (1, True)
    words = ["validator", "check", str(job.result), "--data-dir", str(job.result.parent / "data")]
    done = CliRunner().invoke(main, words)
    assert (done.exit_code, "[corrupt-recording]" in done.stderr) == (2, True)


def test_findings_are_printed_as_json(job: SampleJob) -> None:
    done = checked(job, "--policy", "rate", "--json")
    said = json.loads(done.stdout)
    assert said["holds"] is True
    assert [policy["name"] for policy in said["policies"]] == ["complete", "rate"]
    assert {finding["policy"] for finding in said["findings"]} == {"complete", "rate"}


def test_own_checks_of_a_program_are_applied_without_running_its_validator(job: SampleJob, tmp_path: Path) -> None:
    (tmp_path / "loud.py").write_text(PROGRAM)
    done = checked(job, "--checks", tmp_path / "loud.py", "--json")
    assert done.exit_code == 1, done.output
    found = [one for one in json.loads(done.stdout)["findings"] if one["holds"] is False]
    assert [(one["policy"], one["code"]) for one in found] == [("loud", "check")] * len(WORDS)
    assert found[0]["detail"] == "one at 0 s is not loud"


@pytest.mark.parametrize(
    ("more", "code"),
    [
        (["--policy", "nonsense"], "invalid-policy"),
        (["--checks", "nowhere.py"], "file-unreadable"),
        (["--message", "nowhere.json"], "file-unreadable"),
    ],
)
def test_checks_that_can_not_run_are_exit_code_2(job: SampleJob, more: list[str], code: str) -> None:
    done = checked(job, *more)
    assert done.exit_code == 2
    assert f"[{code}]" in done.stderr


def test_a_program_without_a_validator_is_refused(job: SampleJob, tmp_path: Path) -> None:
    (tmp_path / "empty.py").write_text("answer = 42\n")
    done = checked(job, "--checks", tmp_path / "empty.py")
    assert (done.exit_code, "[program-unusable]" in done.stderr) == (2, True)


def test_the_objective_is_fetched_from_the_store_by_the_cid_that_the_recording_names(
    job: SampleJob, tmp_path: Path
) -> None:
    def run(*words: Any) -> Result:
        return CliRunner().invoke(main, [str(word) for word in [*words, "--data-dir", tmp_path / "data"]])

    assert run("objective", "add", job.objective).exit_code == 0
    done = run("validator", "check", job.result)
    assert done.exit_code == 0, done.output

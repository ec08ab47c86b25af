"""Findings on recordings of jobs whose agents crashed, or whose clocks were set."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest

from mesh.base.clock import SYSTEM_CLOCK
from mesh.recording import Recorder, RecordingAbout, open_objective
from mesh.validator.verification import JobFiles, verify
from schemas import cid_of_file
from tests.support.clocks import HOUR, NOON, SECOND, SetClock
from tests.support.validator.jobs import WORDS, SampleJob, failures, make_job, record, stop

if TYPE_CHECKING:
    from pathlib import Path


def interrupted(tmp_path: Path, *parts: tuple[str, ...], clocks: tuple[SetClock, ...] = ()) -> SampleJob:
    """A job whose agent crashed after each of the parts but the last. Each clock is set back in its part."""
    job = make_job(tmp_path)
    about = {name: text for name, text in open_objective(job.result).metadata["aira"].items() if name != "software"}
    job.result.unlink()
    for number, words in enumerate(parts):
        if number:
            job.result.rename(f"{job.result}.part")
        clock = clocks[number] if clocks else SYSTEM_CLOCK
        with Recorder(job.result, RecordingAbout(**about), clock=clock) as recorder:
            for word in words:
                record(recorder, (word,))
                if isinstance(clock, SetClock):
                    clock.pass_by(SECOND)
                    clock.unix_ns -= HOUR
            if number == len(parts) - 1:
                stop(recorder)
    job.claim = msgspec.structs.replace(job.claim, result=cid_of_file(job.result))
    return job


@pytest.mark.parametrize(
    ("parts", "detail"),
    [
        ((WORDS[:3], WORDS[3:]), "all 6 messages of the objective were played, in order"),
        (
            (WORDS[:3], WORDS[1:]),
            "all 6 messages of the objective were played, in order, 2 of them repeated after a crash",
        ),
        (
            (WORDS[:3], WORDS[2:4], WORDS[3:]),
            "all 6 messages of the objective were played, in order, 2 of them repeated after a crash",
        ),
        (((), WORDS), "all 6 messages of the objective were played, in order"),
    ],
)
def test_a_job_continued_after_a_crash_holds(tmp_path: Path, parts: tuple[tuple[str, ...], ...], detail: str) -> None:
    verdict = interrupted(tmp_path, *parts).verify()
    assert failures(verdict) == {}
    closed, played = verdict.of("closed"), verdict.of("played")
    assert closed is not None
    assert (closed.holds, "the agent crashed" in closed.detail) == (None, True)
    assert played is not None
    assert (played.holds, played.detail) == (True, detail)


@pytest.mark.parametrize(("success", "holds"), [(True, False), (None, False), (False, None)])
def test_messages_lost_in_a_crash_refute_a_success(tmp_path: Path, success: bool | None, holds: bool | None) -> None:
    """Unless the job is known to have failed: then they may be missing."""
    job = interrupted(tmp_path, WORDS[:2], WORDS[3:])
    verdict = job.verify(success=success)
    played = verdict.of("played")
    assert played is not None
    assert (played.holds, played.detail[:40]) == (holds, "1 messages are not in the recording: the")
    assert verdict.holds is (holds is None)


def test_a_clock_that_is_set_back_makes_no_honest_recording_fail(tmp_path: Path) -> None:
    """By an hour while the robot works, and by another one before it continues after a crash."""
    job = interrupted(tmp_path, WORDS[:3], WORDS[3:], clocks=(SetClock(), SetClock(NOON - 2 * HOUR)))
    verdict = job.verify()
    assert failures(verdict) == {}
    times = verdict.of("times")
    assert times is not None
    assert times.holds


def test_the_time_of_all_parts_counts_for_the_period_but_not_the_time_between(tmp_path: Path) -> None:
    """Two parts of three and two seconds, with two hours between them by the robot's clock."""
    job = interrupted(tmp_path, WORDS[:3], WORDS[3:], clocks=(SetClock(), SetClock(NOON + 2 * HOUR)))
    for seconds, holds in ((3, False), (4, True)):
        period = (NOON, NOON + seconds * SECOND)
        verdict = verify(job.claim, JobFiles(objective=job.objective, result=job.result, period=period))
        found = verdict.of("period")
        assert found is not None
        assert found.holds is holds, found.detail

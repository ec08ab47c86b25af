"""Findings on what only a recorder writes: clocks, roles, seams, and metadata records."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.recording import ABOUT, CLOCK_RECORD, RECOVERED, Recorder, RecordingAbout, open_objective
from mesh.validator.verification import MOST_SEAMS, JobFiles, verify
from schemas import cid_of_file
from tests.support.objectives import objective
from tests.support.validator.jobs import LIABILITY, OTHER, ROBOT, SampleJob, failures, make_job

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording import ChannelMessage
    from tests.support.validator.jobs import Metadata


def edited(number: int, **fields: Any) -> Any:
    """A forgery that changes fields of one message."""

    def forge(messages: list[ChannelMessage], _metadata: Metadata) -> list[ChannelMessage]:
        message = msgspec.structs.replace(messages[number].message, **fields)
        messages[number] = msgspec.structs.replace(messages[number], message=message)
        return messages

    return forge


def stated(name: str, **values: str) -> Any:
    """A forgery that states other metadata."""

    def forge(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
        metadata.setdefault(name, {}).update(values)
        return messages

    return forge


def without_clock(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    del metadata[CLOCK_RECORD]
    return messages


@pytest.mark.parametrize(
    ("forgery", "name", "why"),
    [
        (without_clock, "clock", "does not state at what time of day"),
        (stated(CLOCK_RECORD, unix_ns="1"), "clock", "part 1 of it begins at another time"),
        (stated(CLOCK_RECORD, unix_ns="9" * 19, log_ns="9" * 19), "clock", "message 0 was recorded before"),
        (stated(RECOVERED, seams="4"), "clock", "states 1 times at which it was begun, and 1 crashes"),
        (stated(RECOVERED, seams="5,4"), "clock", "does not state in order"),
        (stated(ABOUT, topics="/say,/stop"), "roles", "messages on /said, which was not to be recorded"),
        (edited(1, role="agent", sequence=0), "roles", "messages on /said are the agent's"),
        (edited(1, role="robot", sequence=0), "roles", "the unknown role 'robot'"),
        (edited(1, role="", sequence=0), "roles", "nothing says who sent the messages on /said"),
    ],
)
def test_what_no_recorder_writes_fails(job: SampleJob, forgery: Any, name: str, why: str) -> None:
    job.forge(forgery)
    assert why in failures(job.verify())[name]


def test_a_copy_of_a_message_at_its_time_fails(job: SampleJob) -> None:
    def copied(messages: list[ChannelMessage], _metadata: Metadata) -> list[ChannelMessage]:
        again = msgspec.structs.replace(messages[1].message, sequence=1)
        return [*messages[:2], msgspec.structs.replace(messages[1], message=again), *messages[2:]]

    job.forge(copied)
    said = failures(job.verify())
    assert said["duplicates"] == "message 1 on /said has the time and content of the one before it"


def test_a_changed_byte_of_metadata_which_have_no_checksum_is_found(job: SampleJob) -> None:
    data = job.result.read_bytes()
    job.result.write_bytes(data.replace(b"liability", b"LIABILITY"))
    assert "names no liability" in failures(job.verify())["liability"]


def test_the_period_is_checked_if_it_is_known(job: SampleJob) -> None:
    start = open_objective(job.result).start_ns
    for period, holds in (
        ((start - 10**9, start + 10**12), True),
        ((start + 1, start + 10**12), False),
        ((0, 1), False),
    ):
        verdict = verify(job.claim, JobFiles(objective=job.objective, result=job.result, period=period))
        found = verdict.of("period")
        assert found is not None
        assert found.holds is holds
    assert job.verify().of("period") is None


def test_hundreds_of_crashes_are_not_believed_and_cost_no_time(job: SampleJob) -> None:
    seams = ",".join(str(number % 11) for number in range(200_000))
    job.forge(stated(RECOVERED, seams=seams, messages="11"))
    began = time.monotonic()
    assert f"at most {MOST_SEAMS} crashes" in failures(job.verify())["clock"]
    assert time.monotonic() - began < 20


def test_an_objective_without_messages_is_played_at_once(tmp_path: Path) -> None:
    path = tmp_path / "objective.mcap"
    path.write_bytes(objective())
    about = RecordingAbout(liability=LIABILITY, agent=ROBOT.address, lighthouse=OTHER, objective=cid_of_file(path))
    Recorder(tmp_path / "result.mcap", about).close()
    (tmp_path / "other").mkdir()
    job = make_job(tmp_path / "other")
    claim = msgspec.structs.replace(
        job.claim, objective=cid_of_file(path), result=cid_of_file(tmp_path / "result.mcap")
    )
    verdict = SampleJob(path, tmp_path / "result.mcap", claim).verify()
    assert [finding.name for finding in verdict.findings if not finding.holds] == []

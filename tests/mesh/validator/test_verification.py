"""Findings on honest and on forged recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest

from mesh.recording import CLOSED, Recorder, RecordingAbout
from mesh.validator.verification import Claim
from schemas import String, cid_of_bytes, cid_of_file
from schemas.payloads import STRING
from tests.support.validator.jobs import (
    LIABILITY,
    OTHER,
    THIEF,
    WORDS,
    SampleJob,
    failures,
    make_job,
    record,
    renumbered,
    stop,
)

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.recording import ChannelMessage
    from tests.support.validator.jobs import Metadata


def test_every_finding_of_an_honest_job_holds(job: SampleJob) -> None:
    verdict = job.verify()
    assert [finding.name for finding in verdict.findings] == [
        "finalized",
        "signature",
        "result-file",
        "objective-file",
        "readable",
        "statistics",
        "closed",
        "sequence",
        "times",
        "duplicates",
        "roles",
        "clock",
        "liability",
        "agent",
        "lighthouse",
        "objective",
        "played",
    ]
    assert all(finding.holds for finding in verdict.findings)
    assert verdict.holds
    assert verdict.of("played") is not None


def dropped_answer(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    del messages[3]
    return messages


def dropped_and_renumbered(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    del messages[4]
    metadata[CLOSED]["messages"] = str(len(messages))
    return renumbered(messages)


def altered(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    message = msgspec.structs.replace(messages[2].message, payload=String("TWO").encode())
    messages[2] = msgspec.structs.replace(messages[2], message=message)
    return messages


def reordered(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    messages[2], messages[4] = messages[4], messages[2]
    return messages


def reordered_and_renumbered(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    return renumbered(reordered(messages, metadata))


def shortened(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    return messages[:6]


def shortened_without_a_trace(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata[CLOSED]["messages"] = "6"
    return messages[:6]


def added(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata[CLOSED]["messages"] = str(len(messages) + 1)
    message = msgspec.structs.replace(messages[0].message, payload=String("zero").encode())
    return renumbered([msgspec.structs.replace(messages[0], message=message), *messages])


def on_another_topic(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    message = msgspec.structs.replace(messages[0].message, topic="/shout")
    return renumbered([msgspec.structs.replace(messages[0], message=message), *messages[1:]])


def never_closed(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    del metadata[CLOSED]
    return messages


def lossy(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata[CLOSED]["lost"] = "7"
    return messages


def of_another_liability(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata["aira"]["liability"] = OTHER
    return messages


def of_another_agent(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata["aira"]["agent"] = THIEF.address
    return messages


def of_another_objective(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    metadata["aira"]["objective"] = cid_of_bytes(b"easier work")
    return messages


def of_nobody(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    del metadata["aira"]
    return messages


@pytest.mark.parametrize(
    ("forgery", "found"),
    [
        (dropped_answer, {"sequence": "message 1 on /said is missing", "closed": "closed it with 11 messages"}),
        (dropped_and_renumbered, {"played": "message 2 on /say was not played"}),
        (altered, {"played": "message 1 on /say was played with another content"}),
        (
            reordered,
            {
                "sequence": "message 1 on /say is missing (and 2 more)",
                "times": "message 1 on /said was recorded",
                "played": "messages 1 on /say and 2 on /say were played in the wrong order",
            },
        ),
        (
            reordered_and_renumbered,
            {"played": "messages 1 on /say and 2 on /say were played in the wrong order"},
        ),
        (shortened, {"closed": "closed it with 11 messages, and it has 6", "played": "only the first 3 of"}),
        (shortened_without_a_trace, {"played": "only the first 3 of the objective's 6 messages were played"}),
        (added, {"played": "a message on /say was played before message 0 that is not the objective's"}),
        (on_another_topic, {"played": "message 0 on /say was not played, but one on /shout"}),
        (never_closed, {"closed": "did not close it"}),
        (lossy, {"closed": "lost 7 messages"}),
        (of_another_liability, {"liability": f"names the liability '{OTHER}', and it should be {LIABILITY}"}),
        (of_another_agent, {"agent": f"names the agent '{THIEF.address}'"}),
        (of_another_objective, {"objective": "names the objective 'Qm"}),
        (of_nobody, {"liability": "names no liability"}),
    ],
)
def test_a_forged_recording_fails_with_the_right_findings(
    job: SampleJob, forgery: object, found: dict[str, str]
) -> None:
    job.forge(forgery)  # type: ignore[arg-type]
    said = failures(job.verify())
    assert set(said) == set(found)
    for name, detail in found.items():
        assert detail in said[name]


def another_answer(messages: list[ChannelMessage], metadata: Metadata) -> list[ChannelMessage]:
    message = msgspec.structs.replace(messages[1].message, payload=String("yes, one").encode())
    messages[1] = msgspec.structs.replace(messages[1], message=message)
    return messages


def test_a_changed_file_is_not_the_one_that_was_signed(job: SampleJob) -> None:
    signed = job.claim.result
    job.forge(another_answer)
    assert job.verify().holds
    verdict = job.verify(result=signed)
    assert failures(verdict) == {"result-file": f"the result is {cid_of_file(job.result)}, and it should be {signed}"}


def test_a_cut_recording_is_not_readable(job: SampleJob) -> None:
    job.result.write_bytes(job.result.read_bytes()[:-20])
    said = failures(job.verify())
    assert set(said) == {"result-file", "readable"}
    assert "end" in said["readable"]


def test_a_flipped_bit_fails_the_checksum(job: SampleJob) -> None:
    content = bytearray(job.result.read_bytes())
    content[content.index(b"\x28\xb5\x2f\xfd") + 40] ^= 1
    job.result.write_bytes(content)
    assert set(failures(job.verify())) == {"result-file", "readable"}


def test_another_objective_than_the_contracts_fails(job: SampleJob) -> None:
    said = failures(job.verify(objective=cid_of_bytes(b"harder work")))
    assert set(said) == {"objective-file", "objective"}


def test_a_contract_that_has_not_ended_proves_nothing(job: SampleJob) -> None:
    verdict = job.verify(finalized=False, result="", success=None)
    assert set(failures(verdict)) == {"finalized"}
    assert [finding.holds for finding in verdict.findings[:3]] == [False, None, None]


def test_a_contract_that_was_refunded_holds_no_result(job: SampleJob) -> None:
    said = failures(job.verify(result="", success=False))
    assert said == {"finalized": "the contract was refunded or cancelled, and holds no result"}


def test_a_job_that_failed_may_have_played_only_the_beginning(tmp_path: Path) -> None:
    job = make_job(tmp_path, played=WORDS[:2])
    assert "only the first 2" in failures(job.verify())["played"]
    assert job.verify(success=False).holds


def test_topics_that_were_not_recorded_may_be_missing(tmp_path: Path) -> None:
    job = make_job(tmp_path, topics="/say")
    verdict = job.verify()
    assert verdict.holds
    played = verdict.of("played")
    assert played is not None
    assert (played.holds, "without 1 messages of the objective" in played.detail) == (None, True)


def test_lost_messages_fail_the_closed_finding(tmp_path: Path) -> None:
    job = make_job(tmp_path)
    job.result.unlink()
    with Recorder(job.result, RecordingAbout(liability=LIABILITY)) as recorder:
        recorder.record("/said", b"x" * (65 << 20), STRING)
        record(recorder, WORDS)
        stop(recorder)
    assert failures(job.verify())["closed"] == "the recorder lost 1 messages"


def test_unplayed_messages_fail_if_nothing_is_known_of_the_job(tmp_path: Path) -> None:
    job = make_job(tmp_path, played=WORDS[:2])
    job.claim = Claim()
    assert "only the first 2" in failures(job.verify())["played"]


def test_an_objective_that_is_not_a_recording_was_not_played(tmp_path: Path) -> None:
    job = make_job(tmp_path, played=())
    job.objective.write_bytes(b"no recording")
    played = job.verify(success=False).of("played")
    assert played is not None
    assert (played.holds, "is not a recording" in played.detail) == (None, True)
    (tmp_path / "other").mkdir()
    other = make_job(tmp_path / "other")
    other.objective.write_bytes(b"no recording")
    assert "played" in failures(other.verify())

"""Recordings that are said to be what they are not: another job's, of another time, complete."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from mesh.recording import ABOUT, CLOCK_RECORD, CLOSED
from schemas import cid_of_bytes, cid_of_file
from tests.support.validator.forging import (
    both,
    by_another_writer,
    changed,
    covered,
    naive,
    raw,
    signed,
    swapped,
)
from tests.support.validator.lamps import ROBOT, THIEF, FinishedJob, signed_by
from tests.support.validator.tampered_content import cut_files, forged_messages, missing_messages
from tests.support.validator.tampering import (
    DAY,
    HOUR,
    OTHER,
    SECOND,
    Kinds,
    Others,
    Tampering,
    crashing,
    demand_message,
    dropped,
    easier_objective,
    edited,
    flipped,
    lacking,
    moved,
    naming,
    number_payload,
    renamed,
    state_payload,
    stating,
    taken,
    twice,
    with_field,
)


def forged_metadata() -> Kinds:
    """Metadata, statistics and clocks that are altered."""
    seams = tuple(range(1, 50)) * 6
    return {
        "it names another liability": ("complete/liability", naive(naming(liability=OTHER))),
        "it names no liability": ("complete/liability", naive(naming(liability=""))),
        "it names another agent": ("complete/agent", naive(naming(agent=THIEF.address))),
        "it names another lighthouse": ("complete/lighthouse", naive(naming(lighthouse=OTHER))),
        "it names another objective": ("complete/objective", naive(naming(objective=cid_of_bytes(b"easier")))),
        "it names no job at all": ("complete/liability", naive(lacking(ABOUT))),
        "it names two jobs": ("complete/closed", naive(twice(ABOUT, liability=OTHER))),
        "a digit of its liability is changed": (
            "complete/liability",
            raw(lambda data: flipped(data, b"liability", 20)),
        ),
        "it was never closed": ("complete/closed", naive(lacking(CLOSED))),
        "it was closed with another count": ("complete/closed", naive(with_field(CLOSED, messages="7"))),
        "its recorder lost messages": ("complete/closed", naive(with_field(CLOSED, lost="3"))),
        "it does not say whether messages were lost": (
            "complete/closed",
            naive(lambda f: f.metadata[CLOSED].pop("lost")),
        ),
        "it was closed twice": ("complete/closed", naive(twice(CLOSED, lost="3"))),
        "it says that commands were not to be recorded": ("complete/roles", naive(naming(topics="/lamp/state"))),
        "its commands are dropped, as not to be recorded": (
            "complete/played",
            covered(lambda f: f.drop_all("/lamp"), naming(topics="/lamp/state,/lamp/temperature")),
        ),
        "its statistics state fewer messages": (
            "complete/statistics",
            naive(stating(message_count=lambda count: count - 1)),
        ),
        "its statistics state other counts of topics": (
            "complete/statistics",
            naive(stating(channel_message_counts=lambda counts: {**counts, 1: 1})),
        ),
        "its statistics state an earlier begin": (
            "complete/statistics",
            naive(stating(message_start_time=lambda time: time - HOUR)),
        ),
        "its statistics state a later end": (
            "complete/statistics",
            naive(stating(message_end_time=lambda time: time + HOUR)),
        ),
        "its statistics state more topics": (
            "complete/statistics",
            naive(stating(channel_count=lambda count: count + 1)),
        ),
        "its statistics state an attachment": (
            "complete/statistics",
            naive(stating(attachment_count=lambda count: count + 1)),
        ),
        "it does not state when it was begun": ("complete/clock", naive(lacking(CLOCK_RECORD))),
        "its clock is no number": ("complete/clock", naive(lambda f: f.set_clock("noon"))),
        "its clock is a number without end": ("complete/clock", naive(lambda f: f.set_clock("9" * 400))),
        "its clock is an hour ahead of its messages": (
            "complete/clock",
            naive(lambda f: f.set_clock(f.begun() + HOUR)),
        ),
        "its messages begin before its clock": ("complete/clock", naive(lambda f: f.shift(-HOUR))),
        "its two clocks differ": ("complete/clock", naive(lambda f: f.set_clock(f.begun(), log=(f.begun() - HOUR,)))),
        "it was begun twice without a crash": (
            "complete/clock",
            naive(lambda f: f.set_clock(f.begun(), f.begun() + 1)),
        ),
        "it states a crash without a new begin": ("complete/clock", naive(lambda f: f.recovered(20))),
        "it states a crash behind its end": (
            "complete/clock",
            naive(crashing(9999, unix=lambda start: (start, start + 1))),
        ),
        "it states crashes out of order": (
            "complete/clock",
            naive(crashing(40, 20, unix=lambda start: (start, start, start))),
        ),
        "it states hundreds of crashes": (
            "complete/clock",
            naive(crashing(*sorted(seams), unix=lambda start: (start,) * 300)),
        ),
        "it states a crash that was none, at another time": (
            "complete/clock",
            naive(crashing(20, unix=lambda start: (start, start + HOUR))),
        ),
        "dropped commands pass for a crash": ("complete/played", covered(dropped("/lamp", 8, 9, 10), crashing(24))),
        "exchanged commands pass for a crash": (
            "complete/played",
            covered(lambda f: swapped(*f.on("/lamp")[3:5])(f), crashing(10, 11)),
        ),
        "unanswered commands pass for a crash": (
            "acknowledged/answers",
            covered(lambda f: f.drop(*f.on("/lamp/state")[5:]), crashing(40)),
        ),
    }


def shifted_times() -> Kinds:
    """Recordings of another time, consistent in themselves."""
    return {
        "it is from an hour before the job": ("complete/period", naive(moved(-HOUR))),
        "it is from yesterday": ("complete/period", naive(moved(-DAY))),
        "it is from an hour after its Result": ("complete/period", naive(moved(HOUR))),
        "it is from tomorrow": ("complete/period", naive(moved(DAY))),
        "it is from 1970": ("complete/period", naive(lambda f: moved(-f.begun() + 1)(f))),
        "it is from the year 2500": ("complete/period", naive(lambda f: moved(16 * 10**18 - f.begun())(f))),
        "its end lies after its Result": ("complete/period", naive(lambda f: f.shift(HOUR, since=40))),
        "a crash hides that it ended after its Result": (
            "complete/period",
            naive(crashing(20), lambda f: f.shift(HOUR, since=40)),
        ),
    }


def foreign_files(others: Others) -> Kinds:
    """Files, signatures and messages of others, or of other jobs."""
    return {
        "somebody else signed the Result": ("complete/signature", lambda job: signed(job, by=THIEF)),
        "the Result is of another liability": (
            "complete/signature",
            changed(message=lambda job: signed_by(ROBOT, OTHER, cid_of_file(job.recording))),
        ),
        "the Result names another recording": (
            "complete/signature",
            changed(message=lambda job: signed_by(ROBOT, job.liability.address, cid_of_bytes(b"x"))),
        ),
        "the recording was exchanged after it was signed": (
            "complete/signature",
            lambda job: replace(
                naive(edited("/lamp/state", 3, payload=state_payload(level=0.9)))(job), message=job.message
            ),
        ),
        "the fetched file has another CID": ("complete/signature", changed(recording_cid=cid_of_bytes(b"y"))),
        "the message is a Demand": ("complete/signature", changed(message=demand_message)),
        "the message is not readable": ("complete/signature", changed(message=b'{"liability": 1}')),
        "the signature is cut off": ("complete/signature", changed(message=lambda job: job.message[:-9])),
        "the Result says that there was no success": (
            "complete/claimed",
            changed(
                message=lambda job: signed_by(ROBOT, job.liability.address, cid_of_file(job.recording), success=False)
            ),
        ),
        "the promisor claims no success": ("complete/claimed", changed(claimed=False)),
        "it is of another job of the robot": ("complete/liability", taken(others.same_robot)),
        "it is of another robot's job": ("complete/agent", taken(others.other_robot)),
        "it is of another objective": ("complete/objective", taken(others.easier)),
        "it is of an easier objective, renamed to this job": ("complete/played", both(taken(others.easier), renamed)),
        "it is of another job, renamed to this one": ("complete/replayed", both(taken(others.same_robot), renamed)),
        "it is another robot's, renamed to this job": ("complete/replayed", both(taken(others.other_robot), renamed)),
        "it is another job's, renamed and moved to now": (
            "complete/replayed",
            both(taken(others.same_robot), renamed, naive(moved(SECOND))),
        ),
        "it is another job's, renamed, with other temperatures": (
            "complete/replayed",
            both(
                taken(others.same_robot),
                renamed,
                naive(lambda f: f.edit_all("/lamp/temperature", payload=number_payload(30))),
            ),
        ),
        "it is another job's, with another index": (
            "complete/replayed",
            both(taken(others.same_robot), renamed, by_another_writer()),
        ),
        "the objective is exchanged for an easier one": ("complete/objective-file", easier_objective),
        "the objective is no recording": (
            "complete/objective-file",
            lambda job: (job.objective.write_bytes(b"nothing"), job)[1],
        ),
    }


def tamperings(others: Others) -> list[Tampering]:
    """All ways, at least a hundred."""
    groups = (
        cut_files(),
        missing_messages(),
        forged_messages(),
        forged_metadata(),
        shifted_times(),
        foreign_files(others),
    )
    return [Tampering(kind, *found) for group in groups for kind, found in group.items()]


def tampered(job: FinishedJob, one: Tampering, folder: Path) -> FinishedJob:
    """A tampered copy of the job's files."""
    folder.mkdir()
    copy = replace(
        job,
        objective=Path(shutil.copy(job.objective, folder / "objective.mcap")),
        recording=Path(shutil.copy(job.recording, folder / "recording.mcap")),
    )
    return one.tamper(copy)

"""Recordings that were tampered with, each in another way, and the reason for which each must not be paid."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import msgspec

from mesh.recording import recover
from schemas import Demand, encode
from schemas.payloads import encode_value
from tests.support.bags import Bag, BagMessage
from tests.support.validator.forging import (
    Forgery,
    naive,
    read,
    signed,
)
from tests.support.validator.lamps import LIGHTHOUSE, ROBOT, FinishedJob, order

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.support.validator.forging import Change, Tamper

SECOND: Final = 10**9
HOUR: Final = 3600 * SECOND
DAY: Final = 24 * HOUR
OTHER: Final = "0x" + "9" * 40


class Tampering(NamedTuple):
    """A way to tamper with a recording, and the failure by which it is found: `policy/code`."""

    kind: str
    code: str
    tamper: Tamper


Kinds: TypeAlias = "dict[str, tuple[str, Tamper]]"
"""For each kind, the failure by which it is found, and how it is made."""


class Others(NamedTuple):
    """Honest jobs from which a cheat can take something."""

    same_robot: FinishedJob
    """Another job of the same robot, with the same objective."""
    other_robot: FinishedJob
    """The same objective, done by another robot."""
    easier: FinishedJob
    """A job with an easier objective."""


def number_payload(value: float) -> bytes:
    return encode_value(float(value))[0]


def state_payload(**fields: Any) -> bytes:
    return msgspec.json.encode({"level": 0.0, "mode": "on"} | fields)


def moved(nanoseconds: int) -> Change:
    """Move the whole recording in time, with its clock."""

    def change(forgery: Forgery) -> None:
        forgery.shift(nanoseconds)
        forgery.set_clock(forgery.begun() + nanoseconds)

    return change


def copied(number: int, /, *, after_ns: int = 0, **fields: Any) -> Change:
    """Add a copy of a message behind it."""

    def change(forgery: Forgery) -> None:
        message = forgery.messages[number]
        time = message.log_time_ns + after_ns
        forgery.messages.insert(
            number + 1, msgspec.structs.replace(message, log_time_ns=time, publish_time_ns=time, **fields)
        )

    return change


def at(topic: str, number: int, act: Callable[[Forgery, int], object]) -> Change:
    """Do something with one of the messages on a topic."""
    return lambda forgery: act(forgery, forgery.on(topic)[number])


def edited(topic: str, number: int, /, **fields: Any) -> Change:
    return at(topic, number, lambda forgery, place: forgery.edit(place, **fields))


def numbered(number_of: Callable[[int], int]) -> Change:
    """Give each message another number."""

    def change(forgery: Forgery) -> None:
        for place, message in enumerate(forgery.messages):
            forgery.edit(place, sequence=number_of(message.sequence))

    return change


def dropped(topic: str, *numbers: int) -> Change:
    return lambda forgery: forgery.drop(*(forgery.on(topic)[number] for number in numbers))


def naming(**fields: str) -> Change:
    return lambda forgery: forgery.about.update(fields)


def with_field(name: str, **fields: str) -> Change:
    return lambda forgery: forgery.metadata[name].update(fields)


def lacking(name: str) -> Change:
    return lambda forgery: forgery.metadata.pop(name)


def twice(name: str, **fields: str) -> Change:
    """Write a metadata record twice, the first time with other fields."""

    def change(forgery: Forgery) -> None:
        forgery.more_metadata.append((name, dict(forgery.metadata[name])))
        forgery.metadata[name].update(fields)

    return change


def stating(**fields: Callable[[Any], Any]) -> Change:
    return lambda forgery: forgery.statistics.update(fields)


def second_half_dropped(forgery: Forgery) -> None:
    forgery.drop(*range(forgery.on("/lamp")[10], len(forgery.messages)))


def late_answers(forgery: Forgery) -> None:
    forgery.shift(7 * SECOND, since=forgery.on("/lamp/state")[10])


def crashing(*seams: object, unix: Callable[[int], tuple[object, ...]] | None = None) -> Change:
    """State crashes; by default with clocks that agree."""

    def change(forgery: Forgery) -> None:
        start = forgery.begun()
        forgery.recovered(*seams)
        if unix is not None:
            forgery.set_clock(*unix(start))
            return
        times = [start, *(forgery.messages[int(str(seam)) - 1].log_time_ns for seam in seams)]
        forgery.set_clock(*times)

    return change


def flipped(data: bytes, needle: bytes, offset: int) -> bytes:
    place = data.index(needle) + offset
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


def recovered_file(job: FinishedJob) -> FinishedJob:
    part = job.recording.with_name("cut.mcap.part")
    part.write_bytes(job.recording.read_bytes()[: job.recording.stat().st_size // 2])
    job.recording.unlink()
    recover(part, job.recording)
    return signed(job)


def as_bag(job: FinishedJob) -> FinishedJob:
    messages = [BagMessage(one.topic, one.payload, one.log_time_ns) for one in read(job.recording).messages]
    job.recording.write_bytes(Bag(messages).encode())
    return signed(job)


def flooded(forgery: Forgery) -> None:
    place = forgery.on("/lamp/temperature")[3]
    message = forgery.messages[place]
    more = [
        msgspec.structs.replace(
            message, log_time_ns=message.log_time_ns + number, payload=number_payload(20 + number / 1e4)
        )
        for number in range(3000)
    ]
    forgery.messages[place:place] = more


def demand_message(job: FinishedJob) -> bytes:
    demand = Demand(
        model=job.liability.model,
        objective=job.liability.objective,
        token=OTHER,
        cost=1,
        lighthouse=LIGHTHOUSE,
        validator=OTHER,
        validator_fee=0,
        deadline=1,
        nonce="0" * 64,
    )
    return encode(ROBOT.sign(demand))


def taken(job: FinishedJob) -> Tamper:
    """Hand in the recording of another job."""

    def tamper(own: FinishedJob) -> FinishedJob:
        shutil.copy(job.recording, own.recording)
        return signed(own)

    return tamper


def renamed(own: FinishedJob) -> FinishedJob:
    """Name this job in a recording of another one."""
    about = {"liability": own.liability.address, "agent": own.liability.promisor, "objective": own.liability.objective}
    return naive(naming(**about))(own)


def easier_objective(job: FinishedJob) -> FinishedJob:
    return replace(job, objective=order(job.objective.with_name("easier.mcap"), (0.0, 0.05)))

"""Faults under which honest robots work: crashes, wrong clocks, slow and unplugged lamps."""

from __future__ import annotations

import asyncio
import struct
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import zenoh

from mesh.base.clock import SYSTEM_CLOCK
from schemas.keys import LiabilityTopicKey, ObjectiveTopicKey
from schemas.payloads import Payload, PayloadType, decode_value, encode_value
from tests.support.objectives import MILLISECOND
from tests.support.routers import client_config
from tests.support.validator.lamps import (
    LEVELS,
    ROBOT,
    LampRobot,
    contract,
    order,
    shine,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.recording import Played
    from tests.support.validator.lamps import Handler

HOUR: Final = 3600 * 10**9
SLOW: Final = 45 * MILLISECOND
"""Nanoseconds between two commands, so that a job takes a second, and its position is saved in between."""
CDR: Final = PayloadType("cdr", "std_msgs/msg/Float64", "ros2msg", b"float64 data\n")
ALL_TOPICS: Final = "/lamp,/lamp/state,/lamp/temperature"


class WrongClock:
    """The machine's clock, set by `wrong_ns`; nothing sets the monotonic one."""

    def __init__(self, wrong_ns: int = 0) -> None:
        self.wrong_ns = wrong_ns

    def time(self) -> float:
        return self.time_ns() / 1e9

    def time_ns(self) -> int:
        return SYSTEM_CLOCK.time_ns() + self.wrong_ns

    def monotonic(self) -> float:
        return SYSTEM_CLOCK.monotonic()

    def monotonic_ns(self) -> int:
        return SYSTEM_CLOCK.monotonic_ns()


@dataclass
class Place:
    """Where honest jobs are done."""

    endpoint: str
    session: zenoh.Session
    folder: Path

    def robot(self, name: str, **options: Any) -> LampRobot:
        return LampRobot(self.session, self.folder / name, **options)

    def order(self, name: str, *levels: float, step_ns: int = 5 * MILLISECOND) -> Path:
        (self.folder / name).mkdir()
        return order(self.folder / name / "objective.mcap", levels or LEVELS, step_ns=step_ns)


def failing(error: type[Exception], *places: int, synced: bool = False, then: Callable[[], object] = int) -> Handler:
    """A handler that fails at each of these commands once, and before that perhaps syncs the recording."""
    left = list(places)
    done = 0

    async def handle(job: Job, message: Played) -> None:
        nonlocal done
        done += 1
        if left and done == left[0]:
            left.pop(0)
            if synced:
                await job.sync()  # type: ignore[attr-defined]
            then()
            raise error
        await shine(job, message)

    return handle


async def slowly(job: Job, message: Played) -> None:
    await asyncio.sleep(0.2)
    await shine(job, message)


async def on_many_topics(job: Job, message: Played) -> None:
    for number in range(150):
        job.publish(f"/sensor/{number}", [message.value, number])
    await shine(job, message)


async def in_cdr(job: Job, message: Played) -> None:
    job.publish("/lamp/power", Payload(b"\0\1\0\0" + struct.pack("<d", message.value), CDR))
    await shine(job, message)


@contextmanager
def device(place: Place, name: str, objective: Path, *, temperature: str = "") -> Iterator[None]:
    """A lamp with a session of its own, which answers what is played."""
    address = contract(name, objective).address

    with zenoh.open(client_config(place.endpoint)) as session:

        def put(topic: str, value: object) -> None:
            payload, kind = encode_value(value)
            session.put(str(LiabilityTopicKey(ROBOT.address, address, topic)), payload, encoding=kind.zenoh_encoding)

        def answer(sample: zenoh.Sample) -> None:
            level = decode_value(sample.payload.to_bytes(), FLOAT)
            put(temperature or "/lamp/temperature", 20.5)
            if not temperature:
                put("/lamp/state", {"level": level, "mode": "on"})

        key = str(ObjectiveTopicKey(ROBOT.address, address, "/lamp"))
        subscribers: list[Any] = [session.declare_subscriber(key, answer)]
        subscribers.append(session.declare_subscriber(f"test/{name}{temperature}", print))  # known after the first one
        yield
        for subscriber in subscribers:
            subscriber.undeclare()


FLOAT: Final = encode_value(1.0)[1]


def plugged(place: Place, key: str) -> Any:
    """A lamp that answers queries, until its session is closed."""
    session = zenoh.open(client_config(place.endpoint))
    session.declare_queryable(key, lambda query: query.reply(key, query.payload or b""))
    return session


def asked(place: Place, key: str, payload: bytes) -> bool:
    """Whether the lamp has answered."""
    replies = place.session.get(key, payload=payload, timeout=5.0)
    return any(reply.ok is not None for reply in replies)

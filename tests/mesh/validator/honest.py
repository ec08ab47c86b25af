"""Honest jobs under faults: each must be paid."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import struct
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from mesh.clock import SYSTEM_CLOCK
from schemas import cid_of_file
from schemas.agent_keys import LiabilityTopicKey, ObjectiveTopicKey
from schemas.payloads import Payload, PayloadType, decode_value, encode_value
from tests.mesh.validator.lamps import (
    LEVELS,
    ROBOT,
    SLACK_NS,
    Crashed,
    FinishedJob,
    LampRobot,
    Stopped,
    contract,
    order,
    shine,
    signed_by,
)
from tests.support.bags import Bag, BagMessage
from tests.support.objectives import MILLISECOND
from tests.support.routers import client_config
from tests.support.waiting import until, until_heard

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from mesh.recording import Played
    from mesh.work.job import Job
    from tests.mesh.validator.lamps import Handler

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
def device(place: Place, name: str, objective: Path, *, temperature: str = "") -> Iterator[list[float]]:
    """A lamp with a session of its own, which answers what is played. Yields what it was told."""
    address, told = contract(name, objective).address, list[float]()

    with zenoh.open(client_config(place.endpoint)) as session:

        def put(topic: str, value: object) -> None:
            payload, kind = encode_value(value)
            session.put(str(LiabilityTopicKey(ROBOT.address, address, topic)), payload, encoding=kind.zenoh_encoding)

        def answer(sample: zenoh.Sample) -> None:
            level = decode_value(sample.payload.to_bytes(), FLOAT)
            put(temperature or "/lamp/temperature", 20.5)
            if not temperature:
                put("/lamp/state", {"level": level, "mode": "on"})
            told.append(level)

        key = str(ObjectiveTopicKey(ROBOT.address, address, "/lamp"))
        subscribers: list[Any] = [session.declare_subscriber(key, answer)]
        subscribers.append(session.declare_subscriber(f"test/{name}{temperature}", print))  # known after the first one
        yield told
        for subscriber in subscribers:
            subscriber.undeclare()


FLOAT: Final = encode_value(1.0)[1]


async def plain(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name))


async def at_once(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), playback="at-once")


async def slow(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name, *LEVELS[:8]), slowly, playback="at-once")


async def chosen_topics(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), on_many_topics, topics=ALL_TOPICS)


async def many_topics(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), on_many_topics)


async def ros2_messages(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), in_cdr)


async def bag_objective(place: Place, name: str) -> FinishedJob:
    path = place.order(name)
    messages = [
        BagMessage("/lamp", encode_value(level)[0], number * 5 * MILLISECOND, "std_msgs/Float64", "", "float64 data\n")
        for number, level in enumerate(LEVELS)
    ]
    path.write_bytes(Bag(messages).encode())
    return await place.robot(name).work(name, path)


async def lost_before_the_disk(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), failing(Crashed, 7))


async def crashed(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), failing(Crashed, 11, synced=True))


async def crashed_often(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name), failing(Crashed, 5, 9, 20, 31, synced=True))


async def crashed_late(place: Place, name: str) -> FinishedJob:
    """After its position was saved, so that only some commands are repeated."""
    objective = place.order(name, step_ns=SLOW)
    return await place.robot(name).work(name, objective, failing(Crashed, 17, synced=True))


async def restarted(place: Place, name: str) -> FinishedJob:
    return await place.robot(name).work(name, place.order(name, step_ns=SLOW), failing(Stopped, 4, 9, 15))


async def crashed_at_the_end(place: Place, name: str) -> FinishedJob:
    """After the recording was closed, and before its Result was signed."""
    objective, robot = place.order(name), place.robot(name)
    first = await robot.work(name, objective)
    return replace(await robot.work(name, objective), since_ns=first.since_ns)


async def clock_set_back(place: Place, name: str) -> FinishedJob:
    clock = WrongClock()
    handler = failing(Crashed, 11, synced=True, then=lambda: setattr(clock, "wrong_ns", -HOUR))
    return await place.robot(name, clock=clock).work(name, place.order(name), handler)


async def clock_set_ahead(place: Place, name: str) -> FinishedJob:
    clock = WrongClock()
    handler = failing(Crashed, 11, synced=True, then=lambda: setattr(clock, "wrong_ns", HOUR))
    return await place.robot(name, clock=clock).work(name, place.order(name), handler)


async def clock_set_meanwhile(place: Place, name: str) -> FinishedJob:
    clock = WrongClock()

    async def handle(job: Job, message: Played) -> None:
        clock.wrong_ns += HOUR if int(message.value * 20) % 2 else -2 * HOUR
        await shine(job, message)

    return await place.robot(name, clock=clock).work(name, place.order(name), handle)


async def wrong_clock(place: Place, name: str) -> FinishedJob:
    return await place.robot(name, clock=WrongClock(-SLACK_NS // 2)).work(name, place.order(name))


async def unplugged(place: Place, name: str) -> FinishedJob:
    """The lamp is unplugged for half a second; the robot waits for it."""
    objective = place.order(name, *LEVELS[:6])
    lamp = f"test/lamp/{name}"
    device, done = plugged(place, lamp), 0

    async def handle(job: Job, message: Played) -> None:
        nonlocal done, device
        done += 1
        if done == 3:
            device.close()
            asyncio.get_running_loop().call_later(0.5, plug_in)
        while not await asyncio.to_thread(asked, place, lamp, message.payload):
            await asyncio.sleep(0.02)
        await shine(job, message)

    def plug_in() -> None:
        nonlocal device
        device = plugged(place, lamp)

    try:
        return await place.robot(name).work(name, objective, handle)
    finally:
        device.close()


def plugged(place: Place, key: str) -> Any:
    """A lamp that answers queries, until its session is closed."""
    session = zenoh.open(client_config(place.endpoint))
    session.declare_queryable(key, lambda query: query.reply(key, query.payload or b""))
    return session


def asked(place: Place, key: str, payload: bytes) -> bool:
    """Whether the lamp has answered."""
    replies = place.session.get(key, payload=payload, timeout=0.3)
    return any(reply.ok is not None for reply in replies)


async def several_devices(place: Place, name: str) -> FinishedJob:
    objective, robot = place.order(name), place.robot(name)
    oven = device(place, name, objective, temperature="/oven/temperature")
    with device(place, name, objective) as told, oven as also_told:
        for key in (f"test/{name}", f"test/{name}/oven/temperature"):
            await until_heard(place.session, key)

        async def answered() -> None:
            await until(lambda: len(told) == len(also_told) == len(LEVELS))
            await asyncio.sleep(0.3)  # what they have said arrives

        robot.before_end = answered
        return await robot.work(name, objective, None)


async def signed_again(place: Place, name: str) -> FinishedJob:
    """A reorganisation took the contract back, and the robot signs and sends its Result again."""
    job = await place.robot(name).work(name, place.order(name))
    first = job.judge({})
    assert first.success
    return replace(job, message=signed_by(ROBOT, job.liability.address, cid_of_file(job.recording)))


async def killed(place: Place, name: str) -> FinishedJob:
    """`kill -9` of the robot's process in the middle; another one continues the job."""
    objective, since = place.order(name, step_ns=SLOW), time.time_ns()
    process = await _process(place, name, objective)
    assert process.stdout is not None
    for _ in range(14):
        await process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    await process.wait()
    process = await _process(place, name, objective)
    output, _ = await process.communicate()
    last = json.loads(output.splitlines()[-1])
    recording = Path(last["recording"])
    liability = contract(name, objective)
    return FinishedJob(
        liability=liability,
        objective=objective,
        recording=recording,
        message=signed_by(ROBOT, liability.address, cid_of_file(recording)),
        since_ns=since - SLACK_NS,
        until_ns=time.time_ns() + SLACK_NS,
    )


async def _process(place: Place, name: str, objective: Path) -> asyncio.subprocess.Process:
    words = [place.endpoint, str(place.folder / name), name, str(objective)]
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.mesh.validator.honest", *words, stdout=asyncio.subprocess.PIPE
    )


class HonestKind(NamedTuple):
    """A kind of honest job, and how many there are of it."""

    kind: str
    jobs: int
    work: Callable[[Place, str], Awaitable[FinishedJob]]
    crashes: bool = False
    """Whether its recordings have parts from before a crash."""


KINDS: Final = (
    HonestKind("nothing happens", 8, plain),
    HonestKind("all commands are played at once", 6, at_once),
    HonestKind("the lamp is slow", 4, slow),
    HonestKind("some topics are not recorded", 4, chosen_topics),
    HonestKind("hundreds of topics", 3, many_topics),
    HonestKind("messages of ROS 2", 4, ros2_messages),
    HonestKind("the objective is a ROS 1 bag", 4, bag_objective),
    HonestKind("devices answer, no handlers", 4, several_devices),
    HonestKind("the lamp is unplugged for half a second", 5, unplugged),
    HonestKind("the robot crashes before anything is on the disk", 6, lost_before_the_disk, crashes=True),
    HonestKind("the robot crashes in the middle", 8, crashed, crashes=True),
    HonestKind("the robot crashes four times", 6, crashed_often, crashes=True),
    HonestKind("the robot crashes after its position was saved", 6, crashed_late, crashes=True),
    HonestKind("the robot's process is killed with `kill -9`", 6, killed, crashes=True),
    HonestKind("the robot crashes before it signs the Result", 5, crashed_at_the_end, crashes=True),
    HonestKind("the robot is restarted in order three times", 4, restarted, crashes=True),
    HonestKind("the clock is set while the robot works", 4, clock_set_meanwhile),
    HonestKind("the clock is set back an hour before it continues", 4, clock_set_back, crashes=True),
    HonestKind("the clock is set ahead an hour before it continues", 4, clock_set_ahead, crashes=True),
    HonestKind("the clock is wrong by half a minute", 2, wrong_clock),
    HonestKind("a reorganisation, and the Result is signed again", 3, signed_again),
)
"""A hundred jobs."""


def main() -> None:
    """Do one job in a process of its own: endpoint, folder, name, objective. Prints a line for each command."""
    endpoint, folder, name, objective = sys.argv[1:]

    async def say(job: Job, message: Played) -> None:
        await shine(job, message)
        print(message.value, flush=True)

    with zenoh.open(client_config(endpoint)) as session:
        job = asyncio.run(LampRobot(session, Path(folder)).work(name, Path(objective), say))
    print(json.dumps({"recording": str(job.recording)}), flush=True)


if __name__ == "__main__":
    main()

"""Honest jobs under faults: each must be paid."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from schemas import cid_of_file
from schemas.payloads import encode_value
from tests.support.bags import Bag, BagMessage
from tests.support.objectives import MILLISECOND
from tests.support.routers import client_config
from tests.support.validator.faults import (
    ALL_TOPICS,
    HOUR,
    SLOW,
    Place,
    WrongClock,
    asked,
    device,
    failing,
    in_cdr,
    on_many_topics,
    plugged,
    slowly,
)
from tests.support.validator.lamps import (
    LEVELS,
    ROBOT,
    SLACK_NS,
    Crashed,
    FinishedJob,
    LampRobot,
    Stopped,
    contract,
    shine,
    signed_by,
)
from tests.support.waiting import until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from mesh.agent.handlers import Job
    from mesh.agent.jobs import JobRun
    from mesh.recording import Played


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


async def several_devices(place: Place, name: str) -> FinishedJob:
    objective, robot = place.order(name), place.robot(name)
    oven = device(place, name, objective, temperature="/oven/temperature")
    with device(place, name, objective), oven:
        for key in (f"test/{name}", f"test/{name}/oven/temperature"):
            await until_heard(place.session, key)

        async def answered(run: JobRun) -> None:
            async def is_recorded() -> bool:  # each command, the lamp's two answers, and the oven's
                return (await run.sync())[1] == 4 * len(LEVELS)

            await until_found(is_recorded, what="all answers")

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
    process = await _process(place, name, objective, until=14)
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


async def _process(place: Place, name: str, objective: Path, *, until: int = 0) -> asyncio.subprocess.Process:
    words = [place.endpoint, str(place.folder / name), name, str(objective), str(until)]
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.support.validator.honest", *words, stdout=asyncio.subprocess.PIPE
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
    """Do one job in a process of its own: endpoint, folder, name, objective. Prints a line for each command.

    After the command whose number is the last argument it waits to be killed.
    """
    endpoint, folder, name, objective, last = sys.argv[1:]
    numbers = count(1)

    async def say(job: Job, message: Played) -> None:
        await shine(job, message)
        print(message.value, flush=True)
        if next(numbers) == int(last):
            await asyncio.Event().wait()

    with zenoh.open(client_config(endpoint)) as session:
        job = asyncio.run(LampRobot(session, Path(folder)).work(name, Path(objective), say))
    print(json.dumps({"recording": str(job.recording)}), flush=True)


if __name__ == "__main__":
    main()

"""What real `rosbag record` writes is an objective: plain, compressed, split, and of a recorder that was killed."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING

import pytest

from mesh import Agent
from mesh.recording import RecordingError, open_objective
from mesh.testing import assert_paid
from schemas import String  # noqa: TC001  handlers are read at run time
from tests.support.commands import aira
from tests.support.market import offering
from tests.support.waiting import until

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from mesh.agent.handlers import Job
    from mesh.testing import Market
    from tests.support.ros1.peers import Ros, RosMasterServer

WORDS = [f"{number} ".ljust(100_000, "x") for number in range(30)]


@asynccontextmanager
async def recorded(tools: Ros, topic: str, *options: str) -> AsyncIterator[Process]:
    """`rosbag record` of these words on a topic, which ends when it has them all."""
    async with tools.node("talker", topic) as talker:
        assert await talker.hear() == "ready"
        async with tools.recording(*options, "-l", str(len(WORDS)), topic) as recorder:
            for word in WORDS:
                talker.tell(word)
            yield recorder


async def played(market: Market, *objectives: Path) -> list[str]:
    """What a robot hears in jobs with these objectives, which it is paid for."""
    robot, heard = offering(Agent()), list[str]()

    @robot.on("/say")
    async def say(_job: Job, message: String) -> None:
        heard.append(message.data)

    async with market.robot(robot):
        for path in objectives:
            assert_paid(await market.order(robot, path))
    return heard


@pytest.mark.parametrize("compression", ["", "--bz2", "--lz4"])
async def test_a_recorded_bag_is_played_whole_in_a_paid_job(
    market: Market, tmp_path: Path, rosmaster: RosMasterServer, ros: Callable[[str], Ros], compression: str
) -> None:
    bag = tmp_path / "said.bag"
    async with recorded(ros(rosmaster.uri), "/say", "-O", str(bag), *filter(None, [compression])):
        """Until it ends."""
    done = await asyncio.to_thread(aira, "objective", "check", bag)
    assert (done.returncode, f"valid: {len(WORDS)} messages" in done.stdout) == (0, True), done.stdout
    assert (bag.stat().st_size < 1_000_000) is bool(compression)
    assert await played(market, bag) == WORDS


async def test_each_bag_of_a_split_recording_is_an_objective(
    market: Market, tmp_path: Path, rosmaster: RosMasterServer, ros: Callable[[str], Ros]
) -> None:
    """Together they have everything once."""
    async with recorded(ros(rosmaster.uri), "/say", "--split", "--size", "1", "-O", str(tmp_path / "said.bag")):
        """Until it ends."""
    bags = sorted(tmp_path.glob("said_*.bag"))  # noqa: ASYNC240
    assert len(bags) >= 2
    assert await played(market, *bags) == WORDS


@asynccontextmanager
async def killed(tools: Ros, bag: Path, *options: str) -> AsyncIterator[Path]:
    """What `rosbag record` has written of these words so far; it is killed at the end of the block."""
    async with tools.node("talker", "/say") as talker:
        assert await talker.hear() == "ready"
        async with tools.recording(*options, "-O", str(bag), "/say") as recorder:
            for word in WORDS:
                talker.tell(word)
            yield bag.with_name(f"{bag.name}.active")
            recorder.kill()


async def test_what_a_killed_recorder_wrote_is_an_objective_if_it_is_whole(
    market: Market, tmp_path: Path, rosmaster: RosMasterServer, ros: Callable[[str], Ros]
) -> None:
    """Its bag has no index, so `rosbag` itself can't play it."""

    def is_whole() -> bool:
        with suppress(RecordingError):
            return open_objective(left).count == len(WORDS)
        return False

    tools = ros(rosmaster.uri)
    async with killed(tools, tmp_path / "said.bag", "--chunksize", "1") as left:
        await until(is_whole, what="the last chunk")
    assert "unindexed" in await tools.run("rosbag", "info", str(left))
    assert await played(market, left) == WORDS


async def test_what_a_killed_recorder_wrote_is_refused_if_it_is_cut_and_then_recovered(
    market: Market, tmp_path: Path, rosmaster: RosMasterServer, ros: Callable[[str], Ros]
) -> None:
    """A robot does not play half a recording unasked; the whole chunks of it are an objective again."""
    async with killed(ros(rosmaster.uri), tmp_path / "said.bag") as left:
        await until(lambda: left.exists() and left.stat().st_size > 2_700_000, what="a part of the last chunk")
    done = await asyncio.to_thread(aira, "objective", "check", left)
    assert (done.returncode, "corrupt" in done.stdout) == (1, True), done.stdout
    done = await asyncio.to_thread(aira, "objective", "recover", left)
    assert done.returncode == 0, done.stderr
    heard = await played(market, left.with_name("said.bag.recovered.mcap"))
    assert 16 <= len(heard) < len(WORDS)
    assert heard == WORDS[: len(heard)]

"""An agent loses its disk, is restored from a backup made during its work, and continues."""

from __future__ import annotations

import asyncio
import shutil
from typing import TYPE_CHECKING

from mesh.agent._runtime import AgentRuntime
from mesh.agent.ledger import Phase
from mesh.ops.state import back_up, restore
from mesh.recording import open_objective
from schemas import String
from tests.support.market import in_phase, offering
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from tests.support.market import Place

COST = 1000
STEPS = range(4)


class Robot:
    """A robot that runs several times with the same account and data folder, and all messages that it published."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self.said: list[str] = []
        self.stuck_at = ""
        self.released = asyncio.Event()

    def life(self) -> Agent:
        robot = offering(self._place.agent("robot"))

        @robot.on("/say")
        async def say(job: Job, message: String) -> None:
            if message.data == self.stuck_at:
                await self.released.wait()
            self.said.append(message.data)
            job.publish("/said", message.data)

        return robot

    def stuck(self, at: str) -> None:
        """It does not get over this word until `released`."""
        self.stuck_at, self.released = at, asyncio.Event()


async def ask(place: Place, person: Agent, name: str) -> Contract:
    """A job of four words."""
    words = objective(*(("/say", f"{name} {step}") for step in STEPS))
    return await person.demand(place.save(words, f"{name}.mcap"), cost=COST)


async def recorded(contract: Contract) -> list[str]:
    recording = open_objective(await contract.recording())
    return [String.decode(message.payload).data for message in recording.messages() if message.topic == "/said"]


def lose(disk: Path) -> None:
    shutil.rmtree(disk)


async def test_after_a_restore_every_job_ends_once(place: Place) -> None:
    """One ended before the backup, one ran while it was made and ended after it, one began and ended after it, and one
    ran when the disk was lost."""
    before = await place.balance("robot")
    robot, disk, archive = Robot(place), place.folder / "robot", place.folder / "backup"
    async with place.provider(), place.agent("person") as person:
        async with robot.life():
            first = await ask(place, person, "first")
            await first.outcome()
            robot.stuck(at="second 2")
            second = await ask(place, person, "second")
            await until(lambda: "second 1" in robot.said)
            await back_up(disk, archive, content="needed")
            robot.released.set()
            await second.outcome()
            await (await ask(place, person, "third")).outcome()
            robot.stuck(at="fourth 2")
            fourth = await ask(place, person, "fourth")
            await until(lambda: "fourth 1" in robot.said)
        lose(disk)
        assert await place.balance("robot") == before + 3 * COST

        restored = await restore(archive, disk)

        assert {job.liability.address: job.phase for job in restored.jobs} == {second.address: Phase.RUNNING}
        robot.stuck(at="")
        async with robot.life() as life:
            assert (await fourth.outcome()).success
            await in_phase(life, fourth, Phase.FINALIZED)
            await in_phase(life, second, Phase.FINALIZED)
            assert [one.kind for one in await life.parts.ledger.outbox(head=0)] == []
            assert len(await life.parts.ledger.jobs(Phase)) == 3, "the third had ended before the agent heard of it"
            assert await recorded(fourth) == [f"fourth {step}" for step in STEPS]
    assert await place.balance("robot") == before + 4 * COST
    assert [word for word in robot.said if not word.startswith("fourth")] == [
        f"{name} {step}" for name in ("first", "second", "third") for step in STEPS
    ], "what the chain has paid is not played again"


async def test_jobs_paid_since_the_backup_are_not_repeated_even_if_the_chain_is_slow(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, disk, archive = Robot(place), place.folder / "robot", place.folder / "backup"
    async with place.provider(), place.agent("person") as person, robot.life():
        robot.stuck(at="only 2")
        contract = await ask(place, person, "only")
        await until(lambda: "only 1" in robot.said)
        await back_up(disk, archive, content="needed")
        robot.released.set()
        await contract.outcome()
    lose(disk)
    await restore(archive, disk)
    robot.stuck(at="")

    async def never(_: AgentRuntime) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(AgentRuntime, "_follow_chain", never)
    async with robot.life() as life:
        await in_phase(life, contract, Phase.FINALIZED)
        await life.runtime.executor.wait_until_open()
    assert robot.said == [f"only {step}" for step in STEPS]


async def test_a_job_that_ran_during_the_backup_continues(place: Place) -> None:
    """When nothing has happened since, a restored agent is one that was started again."""
    before = await place.balance("robot")
    robot, disk, archive = Robot(place), place.folder / "robot", place.folder / "backup"
    async with place.provider(), place.agent("person") as person:
        async with robot.life():
            robot.stuck(at="only 2")
            contract = await ask(place, person, "only")
            await until(lambda: "only 1" in robot.said)
        await back_up(disk, archive, content="needed")
        lose(disk)
        await restore(archive, disk)
        robot.stuck(at="")
        async with robot.life():
            assert (await contract.outcome()).success
            assert await recorded(contract) == [f"only {step}" for step in STEPS]
    assert robot.said == [f"only {step}" for step in STEPS]
    assert await place.balance("robot") == before + COST


async def test_a_signed_result_is_sent_unchanged_by_the_restored_agent(place: Place) -> None:
    """The person is paid for by the Result that was signed before the backup, to the byte."""
    robot, disk, archive = Robot(place), place.folder / "robot", place.folder / "backup"
    async with place.agent("person") as person:
        async with robot.life() as life:
            async with place.provider():
                robot.stuck(at="only 0")
                contract = await ask(place, person, "only")
            robot.released.set()
            await in_phase(life, contract, Phase.COMPLETE)
            signed = await life.parts.ledger.outbox(head=0)
            await back_up(disk, archive, content="needed")
        lose(disk)
        await restore(archive, disk)
        async with robot.life() as life:
            assert await life.parts.ledger.outbox(head=0) == signed
            async with place.provider():
                outcome = await contract.outcome()
            await in_phase(life, contract, Phase.FINALIZED)
            job = await life.parts.ledger.job(contract.address)
            assert job is not None
            assert job.result == outcome.result
            assert await recorded(contract) == [f"only {step}" for step in STEPS], "its content came back, too"
    assert robot.said == [f"only {step}" for step in STEPS]

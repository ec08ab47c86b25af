"""With `bag_results` a job whose objective is a bag is answered with a bag, as legacy people expect."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.base.extras import PackageMissing
from mesh.recording import open_objective
from mesh.testing import Market, assert_paid
from mesh.validator.verification import Claim, JobFiles, verify
from schemas import Empty, String, cid_of_file
from tests.support.bags import Bag, BagMessage
from tests.support.log_events import logged_facts
from tests.support.market import MODEL, offering

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job

BAG = Bag([BagMessage("/blink", String(word).encode(), at) for at, word in enumerate(("red", "blue"), 1)]).encode()


@pytest.fixture
def task(tmp_path: Path) -> Path:
    path = tmp_path / "objective.bag"
    path.write_bytes(BAG)
    return path


def answering() -> Agent:
    return offering(Agent(MODEL, settings=Settings(bag_results=True)))


def blinking(says: Any = "on") -> Agent:
    """A robot that says something on /led for each message."""
    robot = answering()

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        job.publish("/led", says)

    return robot


def said(path: Path) -> list[tuple[str, Any]]:
    """The topics and texts of a recording."""
    return [(one.topic, one.value) for one in open_objective(path).messages()]


async def test_a_bag_is_answered_with_a_bag_that_shows_the_job(market: Market, task: Path) -> None:
    """Its topics are named as the legacy software names them, so that it passes the checks of a bag."""
    robot = blinking()
    async with market.robot(robot):
        contract = await market.demand(MODEL, task, cost=42)
        outcome = await market.outcome(contract)
        result = await contract.recording()
        assert_paid(outcome)
        assert open_objective(result).format == "bag"
        below = f"/liability/eth_{contract.address}"
        assert sorted(said(result)) == [
            (f"{below}/blink", "blue"), (f"{below}/blink", "red"), (f"{below}/led", "on"), (f"{below}/led", "on"),
        ]  # fmt: skip
        claim = Claim(
            liability=contract.address, promisor=robot.address, objective=cid_of_file(task), result=outcome.result,
            success=True, finalized=True,
        )  # fmt: skip
        verdict = verify(claim, JobFiles(objective=task, result=result), bags=True)
        assert [one for one in verdict.findings if one.holds is False] == []
        assert {"liability", "played", "result-file"} <= {one.name for one in verdict.findings if one.holds}
        assert not list(robot.parts.recordings.iterdir())


async def test_the_recording_stays_in_the_store_as_it_was_made(
    market: Market, task: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The log names it: it has what a bag can't hold, such as who sent a message."""
    caplog.set_level("INFO")
    robot = blinking()
    async with market.robot(robot):
        person = await market.person()
        outcome = await market.order(MODEL, task, by=person)
        (facts,) = logged_facts(caplog, "job-finished")
        assert facts["result"] == outcome.result != facts["recording"]
        recording = open_objective(await person.fetch(facts["recording"]))
    assert recording.format == "mcap"
    assert {one.role for one in recording.messages()} == {"objective", "device"}


@pytest.mark.parametrize("is_bag", [True, False])
async def test_other_jobs_are_answered_with_the_recording(
    market: Market, task: Path, caplog: pytest.LogCaptureFixture, is_bag: bool
) -> None:
    """Those with an MCAP objective; and those in which a message is none of ROS, which a bag can't hold."""
    robot = blinking({"lamp": "on"} if is_bag else "on")
    async with market.robot(robot):
        contract = await market.demand(MODEL, task if is_bag else [("/blink", Empty())])
        assert_paid(await market.outcome(contract))
        assert open_objective(await contract.recording()).format == "mcap"
    codes = [facts["code"] for facts in logged_facts(caplog, "result-not-a-bag")]
    assert codes == (["unconvertible"] if is_bag else [])


async def test_the_reason_of_a_failed_job_is_read_from_its_bag(market: Market, task: Path) -> None:
    robot = answering()

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        raise ValueError("the lamp is broken")

    async with market.robot(robot):
        contract = await market.demand(MODEL, task)
        outcome = await market.outcome(contract)
        assert open_objective(await contract.recording()).format == "bag"
    assert (outcome.success, outcome.code) == (False, "handler-failed")
    assert "the lamp is broken" in outcome.reason


async def test_what_a_killed_run_left_of_a_bag_is_replaced(market: Market, task: Path) -> None:
    robot = answering()

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        left = robot.parts.recordings / f"{job.liability.address}.bag"
        left.mkdir(exist_ok=True)
        (left / "result.bag").write_bytes(BAG[:1000])

    async with market.robot(robot):
        contract = await market.demand(MODEL, task)
        assert_paid(await market.outcome(contract))
        assert len(said(await contract.recording())) == 2
        assert not list(robot.parts.recordings.iterdir())


async def test_an_agent_does_not_start_without_the_package_that_makes_bags(
    market: Market, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would find out at the end of its first job."""
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(PackageMissing) as caught:
        async with market.robot(answering()):
            pass
    assert caught.value.extra == "ros"

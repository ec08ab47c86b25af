"""With `bag_results` a job whose objective is a bag is answered with a bag, as legacy people expect."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import pytest

from mesh.base.extras import PackageMissing
from mesh.recording import open_objective
from mesh.validator.verification import Claim, JobFiles, verify
from schemas import Empty, String, cid_of_file
from tests.support.bags import Bag, BagMessage
from tests.support.log_events import logged_facts
from tests.support.market import Place, offering
from tests.support.objectives import objective

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job

BAG = Bag([BagMessage("/blink", String(word).encode(), at) for at, word in enumerate(("red", "blue"), 1)]).encode()


def blinking(place: Place, says: Any = "on", **options: Any) -> Agent:
    """A robot that says something on /led for each message."""
    robot = offering(place.agent("robot", bag_results=True, **options))

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        job.publish("/led", says)

    return robot


def said(path: Path) -> list[tuple[str, Any]]:
    """The topics and texts of a recording."""
    return [(one.topic, one.value) for one in open_objective(path).messages()]


async def test_a_bag_is_answered_with_a_bag_that_shows_the_job(place: Place) -> None:
    """Its topics are named as the legacy software names them, so that it passes the checks of a bag."""
    robot = blinking(place)
    async with place.at_work(robot) as person:
        task = place.save(BAG, "objective.bag")
        contract = await person.demand(task, cost=42)
        outcome = await contract.outcome()
        result = await contract.recording()
        assert outcome.success
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


async def test_the_recording_stays_in_the_store_as_it_was_made(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    """The log names it: it has what a bag can't hold, such as who sent a message."""
    caplog.set_level("INFO")
    robot = blinking(place)
    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(BAG, "objective.bag"))
        outcome = await contract.outcome()
        (facts,) = logged_facts(caplog, "job-finished")
        assert facts["result"] == outcome.result != facts["recording"]
        recording = open_objective(await person.fetch(facts["recording"]))
    assert recording.format == "mcap"
    assert {one.role for one in recording.messages()} == {"objective", "device"}


@pytest.mark.parametrize("is_bag", [True, False])
async def test_other_jobs_are_answered_with_the_recording(
    place: Place, caplog: pytest.LogCaptureFixture, is_bag: bool
) -> None:
    """Those with an MCAP objective; and those in which a message is none of ROS, which a bag can't hold."""
    robot = blinking(place, {"lamp": "on"} if is_bag else "on")
    content = BAG if is_bag else objective(("/blink", Empty()))
    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(content))
        assert (await contract.outcome()).success
        assert open_objective(await contract.recording()).format == "mcap"
    codes = [facts["code"] for facts in logged_facts(caplog, "result-not-a-bag")]
    assert codes == (["unconvertible"] if is_bag else [])


async def test_the_reason_of_a_failed_job_is_read_from_its_bag(place: Place) -> None:
    robot = offering(place.agent("robot", bag_results=True))

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        raise ValueError("the lamp is broken")

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(BAG, "objective.bag"))
        outcome = await contract.outcome()
        assert open_objective(await contract.recording()).format == "bag"
    assert (outcome.success, outcome.code) == (False, "handler-failed")
    assert "the lamp is broken" in outcome.reason


async def test_what_a_killed_run_left_of_a_bag_is_replaced(place: Place) -> None:
    robot = offering(place.agent("robot", bag_results=True))

    @robot.on("/blink")
    async def blink(job: Job, _message: Any) -> None:
        left = robot.parts.recordings / f"{job.liability.address}.bag"
        left.mkdir(exist_ok=True)
        (left / "result.bag").write_bytes(BAG[:1000])

    async with place.at_work(robot) as person:
        contract = await person.demand(place.save(BAG, "objective.bag"))
        assert (await contract.outcome()).success
        assert len(said(await contract.recording())) == 2
        assert not list(robot.parts.recordings.iterdir())


async def test_an_agent_does_not_start_without_the_package_that_makes_bags(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would find out at the end of its first job."""
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(PackageMissing) as caught:
        async with place.agent("robot", bag_results=True):
            pass
    assert caught.value.extra == "ros"

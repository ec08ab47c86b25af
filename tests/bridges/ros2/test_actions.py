"""Actions, between two nodes of ours on a real router."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import pytest

from bridges.ros2 import LATCHED, Robot, RosAllowed, RosError, RosGoal, RosGoalFailed
from bridges.ros2._services import ROBOT_LIMITS
from mesh import RosTypes
from mesh.errors import ConfigurationError
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zenoh

FIBONACCI: Final = "example_interfaces/Fibonacci"
FIBONACCI_FULL: Final = "example_interfaces/action/Fibonacci"
DEFINITION: Final = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"


@pytest.fixture
def ros() -> RosTypes:
    types = RosTypes("jazzy")
    types.register(FIBONACCI, DEFINITION)
    return types


class Recorded:
    """What a job would record."""

    def __init__(self) -> None:
        self.topics: list[str] = []

    def publish(self, topic: str, message: object) -> None:
        self.topics.append(topic)


async def fibonacci(goal: RosGoal) -> dict[str, list[int]]:
    sequence = [0, 1]
    for _ in range(goal.request.order):
        sequence.append(sequence[-1] + sequence[-2])
        goal.feedback({"sequence": sequence})
        await asyncio.sleep(0.01)
    return {"sequence": sequence}


@pytest.mark.parametrize("flavour", ["rmw_zenoh", "ros2dds"])
@pytest.mark.parametrize("distribution", ["jazzy", "humble"])
async def test_a_goal_is_achieved_with_feedback(
    here: zenoh.Session, there: zenoh.Session, domain: int, flavour: Any, distribution: str
) -> None:
    ros, name, job = RosTypes(distribution), f"/fibonacci{domain}", Recorded()
    ros.register(FIBONACCI, DEFINITION)
    progress: list[int] = []
    async with (
        Robot(here, ros, domain=domain, flavour=flavour) as ours,
        Robot(there, ros, domain=domain, node="server", flavour=flavour) as server,
    ):
        server.serve_action(name, FIBONACCI, fibonacci)
        result = await ours.action(
            name, FIBONACCI, {"order": 4}, feedback=lambda one: progress.append(len(one.sequence)), timeout=20, job=job
        )
        actions, topics, services = ours.graph.actions(), ours.graph.topics(), ours.graph.services()

    assert list(result.sequence) == [0, 1, 1, 2, 3, 5]
    assert progress == [3, 4, 5, 6]
    assert job.topics[0] == f"{name}/_action/send_goal/_request"
    assert job.topics.count(f"{name}/_action/feedback") == 4
    assert f"{name}/_action/get_result/_reply" in job.topics
    assert (actions, topics, services) == ({name: [FIBONACCI_FULL]}, {}, {})


async def states(ours: Robot, name: str, number: int) -> Iterator[int]:
    """The last states of goals that a server has published."""
    found: list[int] = []
    async with asyncio.timeout(20), ours.subscribe(f"{name}/_action/status", qos=LATCHED) as messages:
        async for message in messages:
            read = ours.types.decode("action_msgs/GoalStatusArray", message.payload.data)
            found = [status.status for status in read.status_list]
            if len(found) >= number and all(status > 3 for status in found):
                break
    return iter(found)


async def test_cancelling_the_call_cancels_the_goal(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    goals: list[RosGoal] = []

    async def forever(goal: RosGoal) -> None:
        goals.append(goal)
        await asyncio.Event().wait()

    async with (
        Robot(here, ros, domain=domain) as ours,
        Robot(there, ros, domain=domain, node="server") as server,
    ):
        server.serve_action("/drive", FIBONACCI, forever)
        running = asyncio.create_task(ours.action("/drive", FIBONACCI, {"order": 1}))
        await until(lambda: goals, what="a goal")
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        with pytest.raises(RosGoalFailed) as late:
            await ours.action("/drive", FIBONACCI, {"order": 1}, timeout=0.5)

        assert list(await states(ours, "/drive", 2)) == [5, 5]
    assert str(late.value).startswith("/drive: ")


async def test_goals_are_aborted_cancelled_and_rejected(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def achieve(goal: RosGoal) -> object:
        if goal.request.order == 1:
            raise RuntimeError("as planned")
        with suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
        return {"sequence": [7]}

    async with (
        Robot(here, ros, domain=domain) as ours,
        Robot(there, ros, domain=domain, node="server") as server,
    ):
        server.serve_action("/drive", FIBONACCI, achieve)
        with pytest.raises(RosGoalFailed) as aborted:
            await ours.action("/drive", FIBONACCI, {"order": 1}, timeout=20)

        running = asyncio.create_task(ours.action("/drive", FIBONACCI, {"order": 2}, timeout=20))
        cancel: dict[str, Any] = {"goal_info": {}}
        cancelling: list[Any] = []
        while not cancelling:
            reply = await ours.call("/drive/_action/cancel_goal", "action_msgs/CancelGoal", cancel)
            cancelling = list(reply.goals_canceling)
        with pytest.raises(RosGoalFailed) as cancelled:
            await running
        unknown = {"goal_info": {"goal_id": {"uuid": b"x" * 16}}}
        reply = await ours.call("/drive/_action/cancel_goal", "action_msgs/CancelGoal", unknown)

        monkeypatch.setattr("bridges.ros2._services.ROBOT_LIMITS", ROBOT_LIMITS._replace(goals=0))
        with pytest.raises(RosGoalFailed) as rejected:
            await ours.action("/drive", FIBONACCI, {"order": 2}, timeout=20)

    assert (aborted.value.status, cancelled.value.status, rejected.value.status) == (
        "aborted",
        "cancelled",
        "rejected",
    )
    assert list(cancelled.value.result.sequence) == [7]  # type: ignore[attr-defined]
    assert reply.return_code == 2


async def test_an_action_must_be_there_and_allowed(here: zenoh.Session, domain: int, ros: RosTypes) -> None:
    async with Robot(here, ros, domain=domain, allow=RosAllowed(call=("/drive",))) as ours:
        with raises_with(RosError, code="ros-unavailable"):
            await ours.action("/drive", FIBONACCI, {}, timeout=0.1)
        with raises_with(ConfigurationError, code="ros-not-allowed"):
            await ours.action("/fly", FIBONACCI, {})
        with raises_with(ConfigurationError, code="ros-not-allowed"):
            ours.serve_action("/drive", FIBONACCI, fibonacci)


async def test_a_goal_of_the_robot_becomes_a_payload_with_its_definition(ros: RosTypes) -> None:
    sent = ros.message(f"{FIBONACCI_FULL}_FeedbackMessage", goal_id={"uuid": b"g" * 16}, feedback={"sequence": [1]})

    assert sent.type.schema_name == "example_interfaces/action/Fibonacci_FeedbackMessage"
    assert b"MSG: example_interfaces/Fibonacci_Feedback\nint32[] sequence\n" in sent.type.schema_data


async def test_a_goal_whose_acceptance_is_not_known_yet_is_cancelled_too(
    here: zenoh.Session, there: zenoh.Session, domain: int, ros: RosTypes
) -> None:
    name, sent, cancelled = f"/slow{domain}", asyncio.Event(), asyncio.Event()

    async def accept(request: Any) -> dict[str, Any]:
        sent.set()
        await cancelled.wait()  # the robot has begun already
        return {"accepted": True}

    async def cancel(request: Any) -> dict[str, Any]:
        cancelled.set()
        return {}

    async with Robot(here, ros, domain=domain) as ours, Robot(there, ros, domain=domain, node="server") as server:
        server.serve(f"{name}/_action/send_goal", f"{FIBONACCI_FULL}_SendGoal", accept)
        server.serve(f"{name}/_action/cancel_goal", "action_msgs/srv/CancelGoal", cancel)
        goal = asyncio.create_task(ours.action(name, FIBONACCI, {"order": 1}))
        await sent.wait()
        goal.cancel()
        await until(cancelled.is_set)
        with suppress(asyncio.CancelledError):
            await goal

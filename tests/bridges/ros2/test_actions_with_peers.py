"""Actions of other ROS 2 systems, in both directions."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ros2 import RosError, RosGoalFailed
from tests.support.raising import raises_with
from tests.support.ros2.definitions import FIBONACCI, ros_types
from tests.support.ros2.peers import hiroz

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from bridges.ros2 import Robot, RosGoal
    from tests.support.routers import EmbeddedRouter

    OurRobot = Callable[..., AbstractAsyncContextManager[Robot]]

DISTRIBUTIONS = pytest.mark.parametrize("distribution", ["jazzy", "humble"])
ACCEPTED, EXECUTING, SUCCEEDED, CANCELED, ABORTED = 1, 2, 4, 5, 6


async def fibonacci(goal: RosGoal) -> dict[str, Any]:
    """Publish each number as feedback; an order of 0 fails."""
    sequence = [0, 1]
    for _ in range(goal.request.order - 1):
        await asyncio.sleep(0.05)
        sequence.append(sum(sequence[-2:]))
        goal.feedback({"partial_sequence": sequence})
    if not goal.request.order:
        raise ValueError("an order of 0")
    return {"sequence": sequence}


@DISTRIBUTIONS
async def test_a_goal_for_a_peer_has_feedback_and_a_result(
    distribution: str, router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    feedback: list[list[int]] = []
    server = hiroz("fibonacci-server", router.endpoint, distribution=distribution)
    async with server as peer, our_robot(ros_types(distribution)) as robot:
        result = await robot.action(
            "/fibonacci",
            FIBONACCI,
            {"order": 5},
            feedback=lambda message: feedback.append(message.partial_sequence.tolist()),
            timeout=30,
        )
        assert peer.is_alive
    assert result.sequence.tolist() == [0, 1, 1, 2, 3, 5]
    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3], [0, 1, 1, 2, 3, 5]]


async def test_a_goal_that_a_peer_aborts_or_refuses_fails(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    refusing = hiroz("fibonacci-server", router.endpoint, action="/refusing", node="refusing", refuse=1)
    async with hiroz("fibonacci-server", router.endpoint), refusing, our_robot() as robot:
        with pytest.raises(RosGoalFailed) as aborted:
            await robot.action("/fibonacci", FIBONACCI, {"order": 0}, timeout=30)
        assert aborted.value.status == "aborted"
        with pytest.raises(RosGoalFailed) as refused:
            await robot.action("/refusing", FIBONACCI, {"order": 3}, timeout=30)
        assert refused.value.status == "rejected"


@DISTRIBUTIONS
async def test_a_cancelled_call_cancels_the_goal_of_a_peer(
    distribution: str, router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    server = hiroz("fibonacci-server", router.endpoint, distribution=distribution)
    async with server as peer, our_robot(ros_types(distribution)) as robot:
        begun = asyncio.Event()
        goal = robot.action("/fibonacci", FIBONACCI, {"order": 40}, feedback=lambda _: begun.set())
        working = asyncio.create_task(goal)
        await begun.wait()
        working.cancel()
        with pytest.raises(asyncio.CancelledError):
            await working
        assert (await peer.line("canceled"))[:3] == [0, 1, 1]


async def test_a_goal_that_takes_too_long_is_cancelled_at_the_peer(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with hiroz("fibonacci-server", router.endpoint) as peer, our_robot() as robot:
        with pytest.raises(RosGoalFailed):
            await robot.action("/fibonacci", FIBONACCI, {"order": 40}, timeout=1.0)
        assert (await peer.line("canceled"))[:3] == [0, 1, 1]


@DISTRIBUTIONS
async def test_a_peers_goal_for_us_has_feedback_status_and_a_result(
    distribution: str, router: EmbeddedRouter, our_robot: OurRobot
) -> None:
    async with our_robot(ros_types(distribution)) as robot:
        robot.serve_action("/fibonacci", FIBONACCI, fibonacci)
        async with hiroz("fibonacci-client", router.endpoint, distribution=distribution, order=4) as client:
            lines = await client.rest()
    assert lines[0] == {"server": True}
    assert "accepted" in lines[1]
    assert [line["feedback"] for line in lines if "feedback" in line] == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    assert {"result": [0, 1, 1, 2, 3]} in lines
    assert {"status": SUCCEEDED} in lines


async def test_a_peers_goal_that_fails_here_is_aborted(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        robot.serve_action("/fibonacci", FIBONACCI, fibonacci)
        async with hiroz("fibonacci-client", router.endpoint, order=0) as client:
            lines = await client.rest()
    assert {"status": ABORTED} in lines


async def test_a_peer_cancels_its_goal_for_us(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    # Only of Humble: with hashes, hiroz asks for another CancelGoal than ROS 2 has (see test_vectors).
    async with our_robot(ros_types("humble")) as robot:
        robot.serve_action("/fibonacci", FIBONACCI, fibonacci)
        options = {"distribution": "humble", "order": 60, "cancel_after": 2}
        async with hiroz("fibonacci-client", router.endpoint, **options) as client:
            lines = await client.rest()
    assert {"cancel": 0, "canceling": 1} in lines
    assert {"status": CANCELED} in lines


async def test_goals_of_several_peers_are_kept_apart(router: EmbeddedRouter, our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        robot.serve_action("/fibonacci", FIBONACCI, fibonacci)
        clients = [
            hiroz("fibonacci-client", router.endpoint, order=order, node=f"client_{order}") for order in (2, 3, 5)
        ]
        async with clients[0], clients[1], clients[2]:
            results = [await client.line("result") for client in clients]
    assert results == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3, 5]]


async def test_an_action_that_nothing_serves_is_unavailable(our_robot: OurRobot) -> None:
    async with our_robot() as robot:
        with raises_with(RosError, code="ros-unavailable"):
            await robot.action("/fibonacci", FIBONACCI, {"order": 1}, timeout=0.2)

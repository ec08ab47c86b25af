"""What an author of a robot writes: as short as in docs/guides/testing.md."""

from mesh import Agent
from mesh.testing import Market, assert_paid


async def test_a_lift_is_paid(market: Market) -> None:
    robot = Agent()
    robot.on_demand(lambda demand: robot.offer(demand))
    robot.on("/lift", float)(lambda job, metres: job.publish("/height", metres))
    async with market.robot(robot):
        outcome = await market.order(robot, [("/lift", 1.5)], cost="5 XRT")
        assert_paid(outcome)
        assert outcome.recording.values("/height") == [1.5]

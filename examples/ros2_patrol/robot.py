"""The agent: offers to drive a ROS 2 robot to poses, with what the robot says and sees in the recording."""

import asyncio
from contextlib import suppress

from bridges.ros2 import Robot, RosAllowed, RosGoalFailed, RosSubscription
from mesh import Agent, Demand, Job, JobFailed, Verified, cid_of_file, run_until_stopped
from patrol import ACTION, CAMERA, ENDPOINT, GOAL, NAVIGATE, ros, session

agent = Agent(cid_of_file(__file__))  # this program is the behaviour
allowed = RosAllowed(subscribe=(CAMERA,), call=(NAVIGATE,))


async def main() -> None:
    async with Robot(await asyncio.to_thread(session, "client", connect=ENDPOINT), ros, allow=allowed) as robot:
        await robot.ready(NAVIGATE)

        @agent.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            await agent.offer(demand)

        @agent.on(GOAL)
        async def drive(job: Job, message: bytes) -> None:
            pose = ros.decode("geometry_msgs/PoseStamped", message)
            async with robot.subscribe(CAMERA) as pictures:
                watching = asyncio.create_task(record(job, pictures))
                try:
                    await robot.action(NAVIGATE, ACTION, {"pose": pose}, timeout=60, job=job)
                except RosGoalFailed as error:
                    raise JobFailed(str(error)) from None
                finally:
                    watching.cancel()
                    with suppress(asyncio.CancelledError):
                        await watching

        await agent.serve()


async def record(job: Job, pictures: RosSubscription) -> None:
    async for picture in pictures:
        job.publish(CAMERA, picture.payload)


if __name__ == "__main__":
    run_until_stopped(main, settings=agent.settings, role="agent")

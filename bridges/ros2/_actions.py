"""Actions of a ROS 2 system: goals for their servers, and servers of ours.

An action is three services and two topics below `NAME/_action`: send_goal, cancel_goal, get_result, feedback, status.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final
from uuid import uuid4

from bridges.ros2._services import REQUESTS, RosServer
from bridges.ros2._topics import RosPublisher, RosSubscription
from bridges.ros2._wire import ACTION, DEFAULT_QOS, LATCHED, SEND_GOAL, RosError, RosGoalFailed
from mesh.base.log_context import log_event
from schemas.errors import AiraError
from schemas.payloads import Payload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from bridges.ros2._node import RosNode
    from bridges.ros2._services import RosClient, RosRecorder

log = logging.getLogger(__name__)

ACCEPTED: Final = 1
EXECUTING: Final = 2
CANCELING: Final = 3
SUCCEEDED: Final = 4
CANCELED: Final = 5
ABORTED: Final = 6
STATUS: Final = {SUCCEEDED: "succeeded", CANCELED: "cancelled", ABORTED: "aborted"}
CANCEL_GOAL: Final = "action_msgs/srv/CancelGoal"
UNKNOWN_GOAL: Final = 2
GOAL_TERMINATED: Final = 3
"""What a server says about a goal that can't be cancelled."""
GOALS: Final = 64
"""Goals that a server of ours works on at a time, and ended ones whose results it keeps."""


class RosActionClient:
    """Sends goals to the server of an action. `client` makes the client of a service, by name, type and hash."""

    def __init__(
        self, node: RosNode, name: str, type_name: str, client: Callable[..., RosClient], job: RosRecorder | None
    ) -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._client = client
        self._job = job
        self._id = {"uuid": uuid4().bytes}

    async def run(
        self, goal: object, feedback: Callable[[Any], Awaitable[None] | None] | None, timeout: float | None
    ) -> Any:
        """Send one goal; returns the decoded result. The goal is cancelled if that does not come in time.

        Raises `RosGoalFailed`, `RosError`.
        """
        if isinstance(goal, Payload):
            goal = self._node.types.decode(f"{self.type}_Goal", self._node.encoded(f"{self.type}_Goal", goal).data)
        topic = f"{self.name}{ACTION}feedback"
        async with RosSubscription(self._node, topic, f"{self.type}_FeedbackMessage", DEFAULT_QOS, 0.0) as messages:
            listening = asyncio.create_task(self._listen(messages, feedback), name=f"feedback of {self.name}")
            try:
                async with asyncio.timeout(timeout):
                    answer = await self._achieve(goal or {})
                # Feedback comes another way than the result, and may be slower.
                await asyncio.wait((listening,), timeout=0.1)
            except TimeoutError:
                raise RosGoalFailed(self.name, "not achieved in time, and cancelled") from None
            finally:
                listening.cancel()
                await asyncio.wait((listening,))
            if not listening.cancelled() and listening.exception() is not None:
                raise listening.exception()  # type: ignore[misc]
        if answer.status != SUCCEEDED:
            raise RosGoalFailed(self.name, STATUS.get(answer.status, "lost by its server"), answer.result)
        return answer.result

    async def _achieve(self, goal: object) -> Any:
        """Have the goal accepted, and wait for the result. Otherwise cancel it: the robot may have begun."""
        sending = self._service("send_goal", SEND_GOAL)
        try:
            reply = await sending.call({"goal_id": self._id, "goal": goal}, timeout=None, job=self._job)
            if not reply.accepted:
                raise RosGoalFailed(self.name, "rejected")
            result = self._service("get_result", "_GetResult")
            return await result.call({"goal_id": self._id}, timeout=None, job=self._job)
        except (asyncio.CancelledError, RosError):
            await self._cancel()
            raise

    async def _cancel(self) -> None:
        name = f"{self.name}{ACTION}cancel_goal"
        # The service has been the same in all distributions, but not everyone has the hash for it that ROS 2 has.
        hashes = [server.type_hash for server in self._node.others(name, "server") if server.type == CANCEL_GOAL]
        client = self._client(name, CANCEL_GOAL, *hashes[:1])
        with suppress(RosError):
            await client.call({"goal_info": {"goal_id": self._id}}, timeout=5.0, job=self._job)

    def _service(self, name: str, suffix: str) -> RosClient:
        return self._client(f"{self.name}{ACTION}{name}", f"{self.type}{suffix}")

    async def _listen(
        self, messages: RosSubscription, feedback: Callable[[Any], Awaitable[None] | None] | None
    ) -> None:
        """Pass on the feedback on our goal, of all that the server publishes."""
        kind = f"{self.type}_FeedbackMessage"
        async for message in messages:
            try:
                read = self._node.types.decode(kind, message.payload.data)
            except AiraError:
                self._node.drops.count("bad-cdr", messages.topic)
                continue
            if read.goal_id.uuid.tobytes() != self._id["uuid"]:
                continue
            if self._job is not None:
                self._job.publish(messages.topic, message.payload)
            if feedback is not None and inspect.isawaitable(waiting := feedback(read.feedback)):
                await waiting


@dataclass(eq=False)
class RosGoal:
    """A goal that a server of ours works on. Its task is cancelled when the client cancels it."""

    id: bytes
    request: Any
    """The decoded goal."""
    accepted_ns: int
    _publish: Callable[[RosGoal, object], None]
    status: int = ACCEPTED
    result: Any = None
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    task: asyncio.Task[None] | None = None

    def feedback(self, message: object) -> None:
        """Publish feedback: a dict of its fields, or a message. Raises `InvalidPayload`."""
        self._publish(self, message)

    @property
    def info(self) -> dict[str, Any]:
        """What identifies it in messages: the fields of action_msgs/GoalInfo."""
        return {"goal_id": {"uuid": self.id}, "stamp": _stamp(self.accepted_ns)}


class RosActionServer:
    """An action server of ours. `handler` achieves each goal and returns its result.

    A goal whose handler fails is aborted. More than `GOALS` goals at a time are rejected.
    """

    def __init__(
        self, node: RosNode, name: str, type_name: str, handler: Callable[[RosGoal], Awaitable[object]]
    ) -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._handler = handler
        self._goals: dict[bytes, RosGoal] = {}
        below = f"{name}{ACTION}"
        self._status = RosPublisher(node, f"{below}status", "action_msgs/msg/GoalStatusArray", LATCHED)
        self._feedback = RosPublisher(node, f"{below}feedback", f"{type_name}_FeedbackMessage", DEFAULT_QOS)
        self._servers = [
            RosServer(node, f"{below}cancel_goal", CANCEL_GOAL, self._cancel, limit=REQUESTS),
            RosServer(node, f"{below}get_result", f"{type_name}_GetResult", self._get_result, limit=4 * GOALS),
            RosServer(node, f"{below}send_goal", f"{type_name}{SEND_GOAL}", self._accept, limit=REQUESTS),
        ]

    async def close(self) -> None:
        """Withdraw it, and cancel the goals that it works on."""
        for server in self._servers:
            await server.close()
        running = [goal.task for goal in self._goals.values() if goal.task is not None and not goal.ended.is_set()]
        for task in running:
            task.cancel()
        if running:
            await asyncio.wait(running)
        if not self._node.session.is_closed():
            self._feedback.close()
            self._status.close()

    async def _accept(self, request: Any) -> dict[str, Any]:
        identity = request.goal_id.uuid.tobytes()
        running = [goal for goal in self._goals.values() if not goal.ended.is_set()]
        if identity in self._goals or len(running) >= GOALS:
            return {"accepted": False}
        ended = [known for known, goal in self._goals.items() if goal.ended.is_set()]
        for known in ended[: max(0, len(ended) - GOALS + 1)]:  # the oldest
            del self._goals[known]
        goal = self._goals[identity] = RosGoal(identity, request.goal, time.time_ns(), self._publish_feedback)
        goal.task = asyncio.create_task(self._achieve(goal), name=f"achieve {self.name}")
        return {"accepted": True, "stamp": _stamp(goal.accepted_ns)}

    async def _achieve(self, goal: RosGoal) -> None:
        try:
            self._change(goal, EXECUTING)
            result = self._node.encoded(f"{self.type}_Result", await self._handler(goal))
            goal.result = self._node.types.decode(f"{self.type}_Result", result.data)
            status = CANCELED if goal.status == CANCELING else SUCCEEDED
        except asyncio.CancelledError:
            status = CANCELED
        except Exception as error:
            facts = log_event("ros-goal-aborted", action=self.name)
            log.error("%s: a goal failed: %s", self.name, error, exc_info=error, extra=facts)
            status = ABORTED
        if not self._node.session.is_closed():
            self._change(goal, status)
        goal.ended.set()

    async def _get_result(self, request: Any) -> dict[str, Any]:
        goal = self._goals.get(request.goal_id.uuid.tobytes())
        if goal is None:
            return {}
        await goal.ended.wait()
        return {"status": goal.status, "result": goal.result}

    async def _cancel(self, request: Any) -> dict[str, Any]:
        """Cancel a goal; with a time also all that were accepted until then; all of them with neither."""
        identity, stamp = request.goal_info.goal_id.uuid.tobytes(), request.goal_info.stamp
        until_ns = stamp.sec * 10**9 + stamp.nanosec
        named, everything = self._goals.get(identity), not any(identity) and not until_ns
        chosen = [
            goal
            for goal in self._goals.values()
            if not goal.ended.is_set() and (everything or goal is named or 0 < goal.accepted_ns <= until_ns)
        ]
        for goal in chosen:
            self._change(goal, CANCELING)
            if goal.task is not None:
                goal.task.cancel()
        code = 0 if chosen or not any(identity) else UNKNOWN_GOAL if named is None else GOAL_TERMINATED
        return {"return_code": code, "goals_canceling": [goal.info for goal in chosen]}

    def _publish_feedback(self, goal: RosGoal, message: object) -> None:
        self._feedback.put({"goal_id": {"uuid": goal.id}, "feedback": message})

    def _change(self, goal: RosGoal, status: int) -> None:
        goal.status = status
        states = [{"goal_info": one.info, "status": one.status} for one in self._goals.values()]
        self._status.put({"status_list": states})


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}

"""Services of a ROS 2 system, theirs and ours; and what is made of services: parameters of nodes, and actions.

An action is three services and two topics below `NAME/_action`: send_goal, cancel_goal, get_result, feedback, status.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol
from uuid import uuid4

import zenoh

from bridges.ros2._node import CDR_HEADERS, LARGEST_PAYLOAD, RosPublisher, RosSubscription
from bridges.ros2._wire import (
    ACTION,
    DEFAULT_QOS,
    LATCHED,
    SEND_GOAL,
    RosAttachment,
    RosError,
    RosGoalFailed,
    parse_attachment,
)
from mesh.base.background import call_in_loop
from mesh.base.log_context import log_event
from mesh.recording.ros import UnknownRosType
from schemas.errors import AiraError, InvalidPayload
from schemas.payloads import Payload

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from bridges.ros2._node import RosNode
    from mesh.recording.ros import RosTypes

    Handler = Callable[[Any], Awaitable[object]]

log = logging.getLogger(__name__)


class RosRobotLimits(NamedTuple):
    """What a robot has open at a time."""

    endpoints: int = 256
    """Publishers, and clients."""
    requests: int = 64
    """Requests that a service of ours handles; others get an error reply."""
    goals: int = 64
    """Goals that a server of ours works on, and ended ones whose results it keeps."""


ROBOT_LIMITS: Final = RosRobotLimits()
FAREWELL: Final = b"the server can't handle this request"


class RosRecorder(Protocol):
    """What records calls: a job."""

    def publish(self, topic: str, message: object) -> None:
        """Record a message on a topic."""


class RosClient:
    """A client of ours of a service."""

    def __init__(self, node: RosNode, name: str, type_name: str, type_hash: str = "") -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._endpoint = node.endpoint("client", name, type_name, type_hash=type_hash)
        self._endpoint.show()
        self._sequence = 0

    async def call(self, request: object, *, timeout: float | None, job: RosRecorder | None = None) -> Any:
        """Send a request; returns the decoded reply. With `job` both become part of its recording.

        Raises `RosError` if none comes within `timeout` seconds; None stands for a day. Raises `InvalidPayload`.
        """
        payload = self._node.encoded(f"{self.type}_Request", request)
        if job is not None:
            job.publish(f"{self.name}/_request", payload)
        reply = await self._ask(payload, 86_400.0 if timeout is None else max(timeout, 0.001))
        try:
            answer = self._node.types.decode(f"{self.type}_Response", reply)
        except InvalidPayload as error:
            raise RosError(f"{self.name}: its reply does not decode: {error}") from None
        if job is not None:
            job.publish(f"{self.name}/_reply", self._node.payload(f"{self.type}_Response", reply))
        return answer

    def close(self) -> None:
        """Withdraw it. Call it while the session is open."""
        self._endpoint.withdraw()

    async def _ask(self, payload: Payload, timeout: float) -> bytes:
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[bytes | None] = loop.create_future()
        self._sequence += 1
        sequence, attachment = self._sequence, None
        if self._node.flavour.has_attachments:
            attachment = RosAttachment(sequence, time.time_ns(), self._endpoint.gid).encode()

        def settle(reply: bytes | None) -> None:
            if not answered.done():
                answered.set_result(reply)

        def receive(reply: zenoh.Reply) -> None:
            taken = self._accepted(reply, sequence)
            if taken is not None:
                call_in_loop(loop, settle, taken)

        query = zenoh.CancellationToken()
        self._node.session.get(
            self._endpoint.key,
            zenoh.handlers.Callback(receive, lambda: call_in_loop(loop, settle, None), indirect=False),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            payload=payload.data,
            attachment=attachment,
            cancellation_token=query,
        )
        try:
            async with asyncio.timeout(timeout):
                reply = await answered
        except TimeoutError:
            reply = None
        finally:
            query.cancel()  # type: ignore[no-untyped-call]
        if reply is None:
            raise RosError(f"{self.name}: no usable reply within {timeout:g} s")
        return reply

    def _accepted(self, reply: zenoh.Reply, sequence: int) -> bytes | None:
        """A reply's payload if it answers our request. Runs on Zenoh's thread."""
        if reply.ok is None:
            return None
        attachment = None if reply.ok.attachment is None else parse_attachment(reply.ok.attachment.to_bytes())
        fits = attachment is not None and (attachment.sequence, attachment.gid) == (sequence, self._endpoint.gid)
        if (self._node.flavour.has_attachments and not fits) or len(reply.ok.payload) > LARGEST_PAYLOAD:
            self._node.drops.count("bad-reply", self.name)
            return None
        return reply.ok.payload.to_bytes()


class RosServer:
    """A service of ours. `handler` makes a reply of each decoded request.

    A request that is malformed is dropped, and one too many gets an error reply; `drops` counts both.
    """

    def __init__(
        self, node: RosNode, name: str, type_name: str, handler: Callable[[Any], Awaitable[object]], *, limit: int
    ) -> None:
        self.name: Final = name
        self.type: Final = type_name
        self._node = node
        self._handler = handler
        self._places = threading.Semaphore(limit)
        self._loop = asyncio.get_running_loop()
        self._requests: set[asyncio.Task[None]] = set()
        self._endpoint = node.endpoint("server", name, type_name)
        received = zenoh.handlers.Callback(self._receive, indirect=False)
        self._queryable: Any = node.session.declare_queryable(self._endpoint.key, received, complete=True)
        self._endpoint.show()

    async def close(self) -> None:
        """Withdraw it, and cancel the requests that it handles."""
        if not self._node.session.is_closed():
            self._queryable.undeclare()
            self._endpoint.withdraw()
        for request in self._requests:
            request.cancel()
        if self._requests:
            await asyncio.wait(self._requests)

    def _receive(self, query: zenoh.Query) -> None:
        """Take a request on Zenoh's thread, which refuses what is too much or malformed."""
        if query.payload is None or not 4 <= len(query.payload) <= LARGEST_PAYLOAD:
            self._refuse(query, "bad-request")
            return
        data = query.payload.to_bytes()
        attached = None if query.attachment is None else parse_attachment(query.attachment.to_bytes())
        malformed = data[:2] not in CDR_HEADERS
        if malformed or (attached is None and self._node.flavour.has_attachments):
            self._refuse(query, "bad-request")
        elif not self._places.acquire(blocking=False):
            self._refuse(query, "request")
        else:
            call_in_loop(self._loop, self._accept, query, data, attached)

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        self._node.drops.count(reason, self.name)
        with query:
            query.reply_err(FAREWELL)

    def _accept(self, query: zenoh.Query, data: bytes, attached: RosAttachment | None) -> None:
        request = asyncio.create_task(self._handle(query, data, attached), name=f"handle {self.name}")
        self._requests.add(request)
        request.add_done_callback(self._ended)

    def _ended(self, request: asyncio.Task[None]) -> None:
        self._requests.discard(request)
        self._places.release()

    async def _handle(self, query: zenoh.Query, data: bytes, attached: RosAttachment | None) -> None:
        with query:
            try:
                request = self._node.types.decode(f"{self.type}_Request", data)
            except InvalidPayload:
                self._refuse(query, "bad-request")
                return
            try:
                reply = self._node.encoded(f"{self.type}_Response", await self._handler(request))
            except Exception as error:
                facts = log_event("ros-request-failed", service=self.name)
                unexpected = None if isinstance(error, AiraError) else error
                log.error("%s: a request failed: %s", self.name, error, exc_info=unexpected, extra=facts)
                query.reply_err(FAREWELL)
                return
            attachment = None if attached is None else attached._replace(time_ns=time.time_ns()).encode()
            query.reply(self._endpoint.key, reply.data, attachment=attachment)


_CANCEL_CODES: Final = (
    "int8 ERROR_NONE=0\nint8 ERROR_REJECTED=1\nint8 ERROR_UNKNOWN_GOAL_ID=2\nint8 ERROR_GOAL_TERMINATED=3\n"
)
DEFINITIONS: Final = {
    "action_msgs/srv/CancelGoal": (
        f"GoalInfo goal_info\n---\n{_CANCEL_CODES}int8 return_code\nGoalInfo[] goals_canceling"
    ),
    "rcl_interfaces/srv/DescribeParameters": "string[] names\n---\nParameterDescriptor[] descriptors",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nParameterValue[] values",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types",
    "rcl_interfaces/srv/ListParameters": (
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nListParametersResult result"
    ),
    "rcl_interfaces/srv/SetParameters": "Parameter[] parameters\n---\nSetParametersResult[] results",
    "rcl_interfaces/srv/SetParametersAtomically": "Parameter[] parameters\n---\nSetParametersResult result",
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
}
"""The text of each service's `.srv` file, without comments."""


def add_definitions(types: RosTypes) -> None:
    """Add the services to `types`. Raises `UnknownRosType` if those are of ROS 1."""
    if not types.is_ros2:
        raise UnknownRosType(types.distribution, "it is no distribution of ROS 2")
    for name, definition in DEFINITIONS.items():
        if not types.knows(name):
            types.register(name, definition)


_SINGLE: Final = ("bool", "integer", "double", "string")
_FIELDS: Final = (
    "",
    *(f"{kind}_value" for kind in _SINGLE),
    "byte_array_value",
    *(f"{kind}_array_value" for kind in _SINGLE),
)
"""The field that holds a value, by the number of its type (rcl_interfaces/ParameterType)."""
_KINDS: Final[dict[type, int]] = {bool: 1, int: 2, float: 3, str: 4}
_ARRAYS: Final[dict[type, int]] = {bool: 6, int: 7, float: 8, str: 9}


class RosParameters:
    """The parameters of a node: `await robot.parameters("/talker").get("rate")`.

    A value is a bool, int, float, str, bytes or a list of one of the first four; None stands for a parameter that is
    not set. Every method raises `RosError` if the node does not answer.
    """

    def __init__(self, node_name: str, call: Callable[[str, str, dict[str, Any]], Awaitable[Any]]) -> None:
        self.node_name: Final = node_name
        self._call = call

    async def get(self, name: str) -> Any:
        return (await self.get_all(name))[name]

    async def get_all(self, *names: str) -> dict[str, Any]:
        reply = await self._call("get_parameters", "GetParameters", {"names": list(names)})
        if len(reply.values) != len(names):  # a node answers with no values if one parameter is not declared
            return {names[0]: None} if len(names) == 1 else {name: await self.get(name) for name in names}
        return {name: from_value(value) for name, value in zip(names, reply.values, strict=True)}

    async def set(self, **values: Any) -> None:
        """Set parameters. Raises `RosError` with the node's reason if it refuses one.

        Names with dots go in a dict: `set(**{"camera.rate": 5})`.
        """
        parameters = [{"name": name, "value": to_value(value)} for name, value in values.items()]
        reply = await self._call("set_parameters", "SetParameters", {"parameters": parameters})
        refused = [
            f"{name}: {result.reason}"
            for name, result in zip(values, reply.results, strict=False)
            if not result.successful
        ]
        if refused or len(reply.results) != len(values):
            why = "; ".join(refused) or "it did not set all"
            raise RosError(f"{self.node_name}/set_parameters: {why}")

    async def list(self) -> tuple[str, ...]:
        reply = await self._call("list_parameters", "ListParameters", {})
        return tuple(str(name) for name in reply.result.names)


def from_value(value: Any) -> Any:
    """The Python value of a rcl_interfaces/ParameterValue; None if it is not set or of a type that is not known."""
    if not 0 < value.type < len(_FIELDS):
        return None
    found = getattr(value, _FIELDS[value.type])
    if _FIELDS[value.type] == "byte_array_value":
        return bytes(found)
    return [*getattr(found, "tolist", lambda: found)()] if value.type > len(_KINDS) else found


def to_value(value: Any) -> dict[str, Any]:
    """The fields of a rcl_interfaces/ParameterValue. Raises `InvalidPayload` for a value that has none."""
    if value is None:
        return {}
    if isinstance(value, bytes):
        return {"type": 5, "byte_array_value": value}
    if isinstance(value, list | tuple):
        kinds = {type(one) for one in value}
        if kinds == {int, float}:
            kinds = {float}
        number = _ARRAYS.get(kinds.pop() if len(kinds) == 1 else str if not kinds else object, 0)
        value = [*value]
    else:
        number = _KINDS.get(type(value), 0)
    if not number:
        raise InvalidPayload("rcl_interfaces/msg/ParameterValue", f"{value!r} is of no type that a parameter has")
    return {"type": number, _FIELDS[number]: value}


NOT_SET: Final = 0
"""The type of a parameter that does not exist (rcl_interfaces/ParameterType)."""


class RosOwnParameters:
    """The parameters that our node declares; `values` has them by name.

    `refusal` is asked about a new value and says why it is refused; with an empty text it is taken. A parameter keeps
    its type.
    """

    def __init__(self, values: Mapping[str, Any], refusal: Callable[[str, Any], str]) -> None:
        self._types = {name: int(to_value(value)["type"]) for name, value in values.items()}
        self._refusal = refusal
        self.values: Final = dict(values)

    def services(self) -> dict[str, tuple[str, Handler]]:
        """The type and the handler of each service, by its name below the node's."""
        return {
            "get_parameters": ("GetParameters", self._get),
            "get_parameter_types": ("GetParameterTypes", self._get_types),
            "describe_parameters": ("DescribeParameters", self._describe),
            "list_parameters": ("ListParameters", self._list),
            "set_parameters": ("SetParameters", self._set),
            "set_parameters_atomically": ("SetParametersAtomically", self._set_atomically),
        }

    async def _get(self, request: Any) -> object:
        if any(name not in self.values for name in request.names):
            return {"values": []}  # as rclcpp answers
        return {"values": [to_value(self.values[name]) for name in request.names]}

    async def _get_types(self, request: Any) -> object:
        return {"types": [self._types.get(name, NOT_SET) for name in request.names]}

    async def _describe(self, request: Any) -> object:
        return {"descriptors": [{"name": name, "type": self._types.get(name, NOT_SET)} for name in request.names]}

    async def _list(self, request: Any) -> object:
        prefixes = tuple(f"{prefix}." for prefix in request.prefixes)
        named = [name for name in self.values if not prefixes or name in request.prefixes or name.startswith(prefixes)]
        return {"result": {"names": named, "prefixes": sorted({name.rpartition(".")[0] for name in named} - {""})}}

    async def _set(self, request: Any) -> object:
        return {"results": [self._apply([parameter]) for parameter in request.parameters]}

    async def _set_atomically(self, request: Any) -> object:
        return {"result": self._apply(request.parameters)}

    def _apply(self, parameters: list[Any]) -> dict[str, Any]:
        """Take new values, all or none."""
        changes = {str(one.name): from_value(one.value) for one in parameters}
        for one in parameters:
            name = str(one.name)
            if name not in self.values:
                return {"successful": False, "reason": f"there is no parameter {name}"}
            if one.value.type != self._types[name]:
                return {"successful": False, "reason": f"{name} has another type"}
            if why := self._refusal(name, changes[name]):
                return {"successful": False, "reason": why}
        self.values.update(changes)
        return {"successful": True, "reason": ""}


class RosGoalStatus(IntEnum):
    """The states of a goal (action_msgs/GoalStatus)."""

    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


STATUS: Final = {
    RosGoalStatus.SUCCEEDED: "succeeded",
    RosGoalStatus.CANCELED: "cancelled",
    RosGoalStatus.ABORTED: "aborted",
}
CANCEL_GOAL: Final = "action_msgs/srv/CancelGoal"
UNKNOWN_GOAL: Final = 2
GOAL_TERMINATED: Final = 3
"""What a server says about a goal that can't be cancelled."""


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
        if answer.status != RosGoalStatus.SUCCEEDED:
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
    status: int = RosGoalStatus.ACCEPTED
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

    A goal whose handler fails is aborted. Too many goals at a time (`ROBOT_LIMITS`) are rejected.
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
            RosServer(node, f"{below}cancel_goal", CANCEL_GOAL, self._cancel, limit=ROBOT_LIMITS.requests),
            RosServer(
                node, f"{below}get_result", f"{type_name}_GetResult", self._get_result, limit=4 * ROBOT_LIMITS.goals
            ),
            RosServer(node, f"{below}send_goal", f"{type_name}{SEND_GOAL}", self._accept, limit=ROBOT_LIMITS.requests),
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
        if identity in self._goals or len(running) >= ROBOT_LIMITS.goals:
            return {"accepted": False}
        ended = [known for known, goal in self._goals.items() if goal.ended.is_set()]
        for known in ended[: max(0, len(ended) - ROBOT_LIMITS.goals + 1)]:  # the oldest
            del self._goals[known]
        goal = self._goals[identity] = RosGoal(identity, request.goal, time.time_ns(), self._publish_feedback)
        goal.task = asyncio.create_task(self._achieve(goal), name=f"achieve {self.name}")
        return {"accepted": True, "stamp": _stamp(goal.accepted_ns)}

    async def _achieve(self, goal: RosGoal) -> None:
        try:
            self._change(goal, RosGoalStatus.EXECUTING)
            result = self._node.encoded(f"{self.type}_Result", await self._handler(goal))
            goal.result = self._node.types.decode(f"{self.type}_Result", result.data)
            status = RosGoalStatus.CANCELED if goal.status == RosGoalStatus.CANCELING else RosGoalStatus.SUCCEEDED
        except asyncio.CancelledError:
            status = RosGoalStatus.CANCELED
        except Exception as error:
            facts = log_event("ros-goal-aborted", action=self.name)
            log.error("%s: a goal failed: %s", self.name, error, exc_info=error, extra=facts)
            status = RosGoalStatus.ABORTED
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
            self._change(goal, RosGoalStatus.CANCELING)
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

"""The door: translates A2A to the operations of a signer, and back; and the application that serves it over HTTP.

It holds no key of a person, and decides nothing: the signer behind the socket does, by the person's policy. A task is a
job of the signer, with the same id, so it is found again after any process was killed.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from a2a.server.request_handlers import RequestHandler
from a2a.server.request_handlers.request_handler import validate_request_params
from a2a.server.request_handlers.response_helpers import build_error_response
from a2a.server.routes import create_jsonrpc_routes, create_rest_routes
from a2a.types import (
    ListTaskPushNotificationConfigsResponse,
    ListTasksResponse,
    Message,
    Task,
    TaskArtifactUpdateEvent,
    TaskPushNotificationConfig,
    TaskState,
    TaskStatusUpdateEvent,
)
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from a2a.utils.errors import (
    A2AError,
    ContentTypeNotSupportedError,
    InternalError,
    InvalidParamsError,
    TaskNotCancelableError,
    TaskNotFoundError,
    UnsupportedOperationError,
)
from a2a.utils.task import (
    ListTasksCursor,
    decode_list_tasks_cursor,
    encode_list_tasks_cursor,
    validate_history_length,
    validate_page_size,
)
from google.protobuf.json_format import MessageToDict
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.routing import Route

from bridges.a2a._card import KEYS_PATH
from bridges.a2a._tasks import (
    HELP,
    STATES,
    UNKNOWN,
    Wanted,
    answer_to,
    artifact_of,
    changed,
    changes,
    key_of,
    status_of,
    task_of,
    wanted_of,
)
from bridges.serving import guarded
from mesh.errors import AiraError, InputError, public_text
from mesh.signer.protocol import FoundQuotes, FoundRobots, Job, Jobs, SignerError, SignerUnavailable

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Mapping

    from a2a.server.context import ServerCallContext
    from a2a.server.events.event_queue import Event
    from a2a.types import (
        AgentCard,
        CancelTaskRequest,
        DeleteTaskPushNotificationConfigRequest,
        GetExtendedAgentCardRequest,
        GetTaskPushNotificationConfigRequest,
        GetTaskRequest,
        ListTaskPushNotificationConfigsRequest,
        ListTasksRequest,
        SendMessageRequest,
        SubscribeToTaskRequest,
    )
    from starlette.requests import Request
    from starlette.responses import Response

    from bridges.a2a._card import Card, CardKey
    from bridges.a2a._push import Pusher, TaskStore
    from bridges.serving import DoorOptions
    from mesh.base.asgi_server import AsgiApplication, Receive, Send
    from mesh.base.asgi_server import Message as AsgiMessage
    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Recording, SignerAnswer


class A2aLimits(NamedTuple):
    """What clients of the door may use."""

    followed: int = 64
    """Streams, and messages whose answer waits for the end of a job."""
    wait: float = 600.0
    """Seconds for which the answer to a message waits for the end of its job; then it is the task as it is."""
    listed: int = 200
    """Tasks that are listed: the latest."""
    page: int = 50
    """Tasks of one page, unless its client says how many."""
    cancel_attempts: int = 5
    """Attempts to cancel a task whose job is just crossing from one state to the next (`CROSSED`)."""
    cancel_wait: float = 5.0
    """Seconds for which such a job may go on before the next attempt."""


A2A_LIMITS: Final = A2aLimits()
BEFORE_CONTRACT: Final = frozenset({"needs-consent", "ordering", "waiting"})
CROSSED: Final = frozenset({"already-a-contract", "not-a-contract", "order-under-way"})
"""The codes of errors for a job that is just being sent, has become a contract, or is none any more."""


class A2aDoor(RequestHandler):
    """Handles the requests of A2A; with a `robot` (address), orders are for that one alone."""

    def __init__(self, signer: SignerClient, store: TaskStore, pusher: Pusher, *, robot: str = "") -> None:
        self._signer = signer
        self._store = store
        self._pusher = pusher
        self._robot = robot
        self._followed = 0

    @validate_request_params
    async def on_message_send(self, params: SendMessageRequest, context: ServerCallContext) -> Task | Message:
        """Answer a message; an order is answered with its task, once that is over unless the client won't wait."""
        validate_history_length(params.configuration)
        answer = await self._received(params)
        if isinstance(answer, Message):
            return answer
        job = answer
        if not params.configuration.return_immediately:
            with self._following(), contextlib.suppress(TimeoutError):
                async with asyncio.timeout(A2A_LIMITS.wait):
                    async for job in self._changes(answer.job_id):
                        if job.state == "needs-consent":
                            break
        return await self._task(job)

    @validate_request_params
    async def on_message_send_stream(
        self, params: SendMessageRequest, context: ServerCallContext
    ) -> AsyncGenerator[Event]:
        """Answer a message; of an order, stream its task until that is over."""
        validate_history_length(params.configuration)
        with self._following():
            answer = await self._received(params)
            if isinstance(answer, Message):
                yield answer
                return
            async for event in self._events(answer.job_id):
                yield event

    @validate_request_params
    async def on_subscribe_to_task(
        self, params: SubscribeToTaskRequest, context: ServerCallContext
    ) -> AsyncGenerator[Event]:
        """Stream a task from now on until it is over."""
        with self._following():
            job = await self._job(params.id)
            if job.is_over:
                raise UnsupportedOperationError("the task is over: nothing follows")
            async for event in self._events(job.job_id):
                yield event

    @validate_request_params
    async def on_get_task(self, params: GetTaskRequest, context: ServerCallContext) -> Task | None:
        validate_history_length(params)
        return await self._task(await self._job(params.id))

    @validate_request_params
    async def on_list_tasks(self, params: ListTasksRequest, context: ServerCallContext) -> ListTasksResponse:
        validate_history_length(params)
        size = A2A_LIMITS.page
        if params.HasField("page_size"):
            validate_page_size(params.page_size)
            size = params.page_size
        if params.status not in TaskState.values():
            raise InvalidParamsError("there is no such state")
        cursor = decode_list_tasks_cursor(params.page_token) if params.page_token else None
        if params.page_token and cursor is None:
            raise InvalidParamsError("the page token is not one of this agent")
        listed = await self._ask("jobs", {"limit": A2A_LIMITS.listed})
        assert isinstance(listed, Jobs)
        found: list[tuple[ListTasksCursor, Job]] = []
        for job in listed.jobs:
            if params.context_id and self._store.context(job.job_id) != params.context_id:
                continue
            if params.status and STATES[job.state][0] != params.status:
                continue
            moment = changed(job)
            if params.HasField("status_timestamp_after") and moment < params.status_timestamp_after.ToDatetime(
                tzinfo=moment.tzinfo
            ):
                continue
            found.append((ListTasksCursor(round(moment.timestamp() * 1e9), job.job_id), job))
        found.sort(key=lambda one: one[0].sort_key(), reverse=True)
        rest = [one for one in found if cursor is None or one[0].sort_key() < cursor.sort_key()]
        page = rest[:size]
        tasks = [task_of(job, self._store.context(job.job_id)) for _, job in page]
        if not params.include_artifacts:
            for task in tasks:
                task.ClearField("artifacts")
        token = encode_list_tasks_cursor(page[-1][0]) if len(rest) > size else ""
        return ListTasksResponse(tasks=tasks, next_page_token=token, page_size=size, total_size=len(found))

    @validate_request_params
    async def on_cancel_task(self, params: CancelTaskRequest, context: ServerCallContext) -> Task | None:
        """Take an order back, or stop its job once it is a contract."""
        job = await self._job(params.id)
        for attempt in range(A2A_LIMITS.cancel_attempts):
            if job.is_over:
                raise TaskNotCancelableError("the task is over already")
            try:
                if job.state in BEFORE_CONTRACT:
                    job = await self._signer.withdraw(job.job_id)
                else:
                    job = await self._signer.stop_job(job.job_id, why="canceled by its client")
                break
            except AiraError as error:
                if error.code not in CROSSED or attempt == A2A_LIMITS.cancel_attempts - 1:
                    known = error_of(error)
                    raise (
                        known if isinstance(known, InternalError) else TaskNotCancelableError(known.message, known.data)
                    ) from None
                job = await self._job(job.job_id, revision=job.revision, wait_seconds=A2A_LIMITS.cancel_wait)
        return await self._task(job)

    @validate_request_params
    async def on_create_task_push_notification_config(
        self, params: TaskPushNotificationConfig, context: ServerCallContext
    ) -> TaskPushNotificationConfig:
        return await self._push(await self._job(params.task_id), params)

    @validate_request_params
    async def on_get_task_push_notification_config(
        self, params: GetTaskPushNotificationConfigRequest, context: ServerCallContext
    ) -> TaskPushNotificationConfig:
        job = await self._job(params.task_id)
        for config in self._store.pushes(job.job_id):
            if config.id == params.id:
                return config
        raise TaskNotFoundError("the task has no such push notification")

    @validate_request_params
    async def on_list_task_push_notification_configs(
        self, params: ListTaskPushNotificationConfigsRequest, context: ServerCallContext
    ) -> ListTaskPushNotificationConfigsResponse:
        job = await self._job(params.task_id)
        return ListTaskPushNotificationConfigsResponse(configs=self._store.pushes(job.job_id))

    @validate_request_params
    async def on_delete_task_push_notification_config(
        self, params: DeleteTaskPushNotificationConfigRequest, context: ServerCallContext
    ) -> None:
        job = await self._job(params.task_id)
        self._store.no_push(job.job_id, params.id)
        await self._store.sync()

    async def on_get_extended_agent_card(
        self, params: GetExtendedAgentCardRequest, context: ServerCallContext
    ) -> AgentCard:
        """There is none: the card has everything."""
        raise UnsupportedOperationError("there is no other card than the public one")

    async def _received(self, params: SendMessageRequest) -> Message | Job:
        """Do what a message asks for: its answer, or the job that it orders."""
        message = params.message
        if message.task_id:
            job = await self._job(message.task_id)
            if message.context_id and message.context_id != self._store.context(job.job_id):
                raise InvalidParamsError("the task has another context")
            raise UnsupportedOperationError("a task takes no more messages: cancel it, or ask for another one")
        wanted = wanted_of(message)
        if wanted is None:
            return answer_to(message, HELP)
        if wanted.operation != "order":
            return answer_to(message, await self._read(wanted))
        if params.configuration.HasField("task_push_notification_config"):
            self._pusher.check(params.configuration.task_push_notification_config)
        fields = {**wanted.fields, "idempotency_key": key_of(message)}
        if self._robot and fields.setdefault("robot", self._robot) != self._robot:
            raise InvalidParamsError(f"this agent orders from {self._robot} only", {"code": "robot-not-allowed"})
        ordered = await self._ask("order", fields)
        assert isinstance(ordered, Job)
        if message.context_id:
            self._store.keep_context(ordered.job_id, message.context_id)
            await self._store.sync()
        if params.configuration.HasField("task_push_notification_config"):
            await self._push(ordered, params.configuration.task_push_notification_config)
        return ordered

    async def _read(self, wanted: Wanted) -> SignerAnswer:
        fields = dict(wanted.fields)
        if self._robot and wanted.operation == "find_robots":
            fields["text"] = self._robot
        answer = await self._ask(wanted.operation, fields)
        if self._robot and isinstance(answer, FoundQuotes):
            return FoundQuotes(
                quotes=tuple(one for one in answer.quotes if one.robot == self._robot),
                declined=tuple(one for one in answer.declined if one.robot == self._robot),
                objective=answer.objective,
            )
        if self._robot and isinstance(answer, FoundRobots):
            return FoundRobots(robots=tuple(one for one in answer.robots if one.address == self._robot), more=0)
        return answer

    async def _push(self, job: Job, asked: TaskPushNotificationConfig) -> TaskPushNotificationConfig:
        self._pusher.check(asked)
        config = TaskPushNotificationConfig()
        config.CopyFrom(asked)
        config.task_id, config.id = job.job_id, asked.id or job.job_id
        self._store.push(job.job_id, config)
        await self._store.sync()
        self._pusher.watch(job.job_id)
        return config

    async def _events(self, identity: str) -> AsyncIterator[Event]:
        """A job's task, then what changes of it, until it is over."""
        context = self._store.context(identity)
        before: Job | None = None
        async for job in self._changes(identity):
            if before is None:
                yield await self._task(job)
            else:
                if job.result and not before.result:
                    artifact = artifact_of(job, await self._recording(job))
                    yield TaskArtifactUpdateEvent(
                        task_id=identity, context_id=context, artifact=artifact, last_chunk=True
                    )
                event = TaskStatusUpdateEvent(task_id=identity, context_id=context, status=status_of(job, context))
                event.metadata.CopyFrom(task_of(job, context).metadata)
                yield event
            before = job

    async def _changes(self, identity: str) -> AsyncIterator[Job]:
        """See `changes`; raises `A2AError` only."""
        try:
            async for job in changes(self._signer, identity):
                yield job
        except AiraError as error:
            raise error_of(error) from None

    @contextlib.contextmanager
    def _following(self) -> Any:
        if self._followed >= A2A_LIMITS.followed:
            raise InternalError(
                "too many jobs are followed at once; ask for the task later", {"code": "too-many-streams"}
            )
        self._followed += 1
        try:
            yield
        finally:
            self._followed -= 1

    async def _task(self, job: Job) -> Task:
        return task_of(job, self._store.context(job.job_id), await self._recording(job))

    async def _recording(self, job: Job) -> Recording | None:
        """What the recording of a job has, if it has one that can be read now."""
        if not job.result:
            return None
        try:
            return await self._signer.recording(job.job_id)
        except AiraError:
            return None

    async def _job(self, identity: str, *, revision: int = -1, wait_seconds: float = 0.0) -> Job:
        try:
            return await self._signer.job(identity, revision=revision, wait_seconds=wait_seconds)
        except AiraError as error:
            if error.code in UNKNOWN:
                raise TaskNotFoundError from None
            raise error_of(error) from None

    async def _ask(self, operation: str, fields: Mapping[str, Any]) -> SignerAnswer:
        """Raises `A2AError` only."""
        try:
            return await self._signer.ask(operation, fields)
        except AiraError as error:
            raise error_of(error) from None


def error_of(error: AiraError) -> A2AError:
    """An error of A2A, with the code and what to do about it; strangers' words stand apart."""
    data = {"code": error.code, "next": public_text(error.hint)}
    if isinstance(error, SignerError) and error.from_strangers is not None:
        data |= {"from": error.from_strangers.author, "text": error.from_strangers.text}
    is_theirs = isinstance(error, SignerError | InputError) and not isinstance(error, SignerUnavailable)
    kind = InvalidParamsError if is_theirs else InternalError
    return kind(f"{error.code}: {public_text(error)}", data)


def application(door: RequestHandler, card: Card, key: CardKey, options: DoorOptions) -> AsgiApplication:
    async def keys(request: Request) -> Response:
        return JSONResponse(key.published())

    async def served(request: Request) -> Response:
        return JSONResponse(MessageToDict(await card.get()), headers={"Cache-Control": "public, max-age=60"})

    routes = Starlette(
        routes=[
            Route(AGENT_CARD_WELL_KNOWN_PATH, served, methods=["GET"]),
            Route(KEYS_PATH, keys, methods=["GET"]),
            *create_jsonrpc_routes(door, "/"),
            *create_rest_routes(door, path_prefix="/rest"),
        ]
    )

    async def typed(scope: AsgiMessage, receive: Receive, send: Send) -> None:
        kind = Headers(scope=scope).get("content-type", "") if scope["type"] == "http" else ""
        if scope["type"] == "http" and scope["path"] == "/" and not kind.lower().startswith("application/json"):
            refusal = build_error_response(None, ContentTypeNotSupportedError("send application/json"))
            await JSONResponse(refusal)(scope, receive, send)
        else:
            await routes(scope, receive, send)

    return guarded(typed, options, public=(AGENT_CARD_WELL_KNOWN_PATH, KEYS_PATH))

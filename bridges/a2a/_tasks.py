"""The jobs of a signer as tasks of A2A, the requests in messages as operations of a signer, and how a job changes.

Fields are in camelCase here, as everywhere in A2A: a signer's `job_id` is `jobId`.
"""

from __future__ import annotations

import hashlib
import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from uuid import uuid4

import msgspec
from a2a.types import Artifact, Message, Part, Role, Task, TaskState, TaskStatus
from a2a.utils.errors import ContentTypeNotSupportedError, InvalidParamsError
from google.protobuf.json_format import MessageToDict, ParseDict
from google.protobuf.struct_pb2 import Value

from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import AiraError
from mesh.signer.protocol import DOOR
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from mesh.signer.client import SignerClient
    from mesh.signer.protocol import Job, JobState, Recording, SignerAnswer

LONGEST_ID: Final = 200
"""Characters of a client's message and context ids."""
LARGEST_WHOLE: Final = 2**53
"""From here on a number of JSON loses digits, so whole numbers are written as text."""
MEDIA_TYPES: Final = frozenset({"", "application/json", "text/plain"})
"""What parts of messages may say that they are."""
MCAP: Final = "application/x-mcap"
READING: Final = frozenset(
    {"find_robots", "describe_model", "quote", "recording", "verify", "balance", "statement", "jobs"}
)
"""The operations that a message is answered to; `order` makes a task."""
STATES: Final[Mapping[JobState, tuple[TaskState, str]]] = {
    "needs-consent": (TaskState.TASK_STATE_AUTH_REQUIRED, "a person must allow it first; nothing was signed"),
    "ordering": (TaskState.TASK_STATE_SUBMITTED, "it is being signed and sent"),
    "waiting": (TaskState.TASK_STATE_SUBMITTED, "it is on the market, and no contract yet"),
    "accepted": (TaskState.TASK_STATE_WORKING, "it is a contract; the job waits at the robot"),
    "running": (TaskState.TASK_STATE_WORKING, "the robot works"),
    "done": (TaskState.TASK_STATE_COMPLETED, "done and paid"),
    "failed": (TaskState.TASK_STATE_FAILED, "it could not be ordered; nothing was paid"),
    "expired": (TaskState.TASK_STATE_FAILED, "nobody allowed it, or took it, in time; nothing was paid"),
    "refunded": (TaskState.TASK_STATE_FAILED, "the job failed, and its cost came back"),
    "stopped": (TaskState.TASK_STATE_CANCELED, "the job was stopped, and its cost came back"),
    "withdrawn": (TaskState.TASK_STATE_CANCELED, "it was taken back before it became a contract"),
    "denied": (TaskState.TASK_STATE_REJECTED, "a person did not allow it; nothing was signed"),
}
"""What each state of a job is in A2A, and what is said about it."""
HELP: Final = (
    "This agent hires robots, and reads no prose. Send one data part (or a text part that is JSON): "
    '{"operation": "find_robots"}, {"operation": "describe_model", "model": "Qm..."}, '
    '{"operation": "quote", "model": "Qm...", "messages": [{"topic": "/...", "value": ...}]}, '
    'or {"operation": "order", "model": ..., "messages": ..., "cost": "1 XRT"}, which becomes a task.'
)


class Wanted(NamedTuple):
    """What a message asks for: an operation of a signer, with the fields of its request."""

    operation: str
    fields: dict[str, Any]


def wanted_of(message: Message) -> Wanted | None:
    """What a message asks for; None for prose. Raises `InvalidParamsError`, `ContentTypeNotSupportedError`."""
    if len(message.message_id) > LONGEST_ID or len(message.context_id) > LONGEST_ID:
        raise InvalidParamsError(f"an id has at most {LONGEST_ID} characters")
    found: list[dict[str, Any]] = []
    for part in message.parts:
        if part.media_type.partition(";")[0].strip().lower() not in MEDIA_TYPES:
            raise ContentTypeNotSupportedError("send application/json")
        match part.WhichOneof("content"):
            case "data":
                value = _whole(MessageToDict(part.data))
                if not isinstance(value, dict):
                    raise InvalidParamsError("a data part must be an object")
                found.append(value)
            case "text":
                if part.text.lstrip().startswith("{"):
                    try:
                        value = decode_json(part.text)
                    except InvalidData as error:
                        raise InvalidParamsError(f"the text is no JSON: {error}"[:200]) from None
                    found.append(dict(value))
            case _:
                raise ContentTypeNotSupportedError("files are not taken; give the CID of an objective")
    if not found:
        return None
    if len(found) > 1:
        raise InvalidParamsError("one request in a message")
    fields = found[0]
    operation = str(fields.pop("operation", "order" if "cost" in fields else "quote"))
    if operation not in READING | {"order"}:
        raise InvalidParamsError(f"no such operation; there are order, {', '.join(sorted(READING))}")
    known = {_camel(name): name for name in DOOR[operation].request.__struct_fields__ if name != "idempotency_key"}
    for name in fields:
        if name not in known:
            raise InvalidParamsError(f"{operation} has no such field; there are {', '.join(known)}"[:500])
    return Wanted(operation, {known[name]: value for name, value in fields.items()})


def key_of(message: Message) -> str:
    """The idempotency key of an order: the same message, sent again, is the same job."""
    return f"a2a-{hashlib.sha256(message.message_id.encode()).hexdigest()}"


def answer_to(message: Message, answer: SignerAnswer | str) -> Message:
    """The reply to a message: an answer of the signer, or a text in constant words."""
    part = Part(text=answer) if isinstance(answer, str) else data_part(msgspec.to_builtins(answer))
    context = message.context_id or str(uuid4())
    return Message(message_id=str(uuid4()), context_id=context, role=Role.ROLE_AGENT, parts=[part])


def task_of(job: Job, context: str, recording: Recording | None = None) -> Task:
    """A job as a task; its `metadata` has the whole job, in which strangers' texts are marked."""
    task = Task(id=job.job_id, context_id=context, status=status_of(job, context))
    if job.result:
        task.artifacts.append(artifact_of(job, recording))
    ParseDict({"job": _shown(msgspec.to_builtins(job))}, task.metadata)
    return task


def status_of(job: Job, context: str) -> TaskStatus:
    """The status of a job's task, with what to do about it."""
    state, said = STATES[job.state]
    if job.consent is not None:
        said += f"; {job.consent.why}: `{job.consent.command}` allows it, until {job.consent.expires}"
    if job.error is not None:
        said += f"; {job.error.code}: {job.error.message}" + (f"; {job.error.next}" if job.error.next else "")
    part = Part(text=said)
    identity = f"{job.job_id}-{job.revision}"
    said_by_us = Message(
        message_id=identity, context_id=context, task_id=job.job_id, role=Role.ROLE_AGENT, parts=[part]
    )
    status = TaskStatus(state=state, message=said_by_us)
    status.timestamp.FromDatetime(changed(job))
    return status


def artifact_of(job: Job, recording: Recording | None = None) -> Artifact:
    """The recording of a job: what it has if that was read, with the last value of each topic, and the file itself."""
    content = {"cid": job.result, "contract": job.contract, "robot": job.robot, "objective": job.objective}
    if recording is not None:
        content["recording"] = msgspec.to_builtins(recording)
    return Artifact(
        artifact_id=job.result,
        name="recording",
        description="what the robot recorded, and the file (MCAP) by its CID; the operation `recording` reads more",
        parts=[data_part(content), Part(url=f"ipfs://{job.result}", filename=f"{job.result}.mcap", media_type=MCAP)],
    )


def data_part(value: Any) -> Part:
    part = Part(media_type="application/json")
    part.data.CopyFrom(ParseDict(_shown(value), Value()))
    return part


def changed(job: Job) -> datetime:
    moment = datetime.fromisoformat(job.changed)
    return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)


def _shown(value: Any) -> Any:
    """An answer of a signer, whose keys are fields, in JSON of A2A."""
    if isinstance(value, dict):
        return {_camel(name): _shown(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_shown(each) for each in value]
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= LARGEST_WHOLE:
        return str(value)
    return value


def _camel(name: str) -> str:
    return re.sub("_([a-z])", lambda found: found[1].upper(), name)


def _whole(value: Any) -> Any:
    """A value whose whole numbers are integers again: A2A has floating-point numbers only."""
    if isinstance(value, dict):
        return {name: _whole(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_whole(each) for each in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < LARGEST_WHOLE:
        return int(value)
    return value


UNKNOWN: Final = frozenset({"invalid-request", "unknown-job"})
"""The codes of errors for a job that there is none of."""


async def changes(signer: SignerClient, job_id: str) -> AsyncIterator[Job]:
    """A job as it is now, then each time it has changed; the last time when it is over.

    Waits while the signer is away. Raises the `AiraError` of a job that there is none of.
    """
    before: Job | None = None
    revision, backoff = -1, Backoff(RetryPolicy(initial=1.0, ceiling=5.0))
    while True:
        try:
            job = await signer.job(job_id, revision=revision, wait_seconds=25.0)
        except AiraError as error:
            if error.code in UNKNOWN:
                raise
            revision = -1  # after a restart it may be the same for something else
            await backoff.wait()
            continue
        backoff.reset()
        revision = job.revision
        if job != before:
            before = job
            yield job
        if job.is_over:
            return

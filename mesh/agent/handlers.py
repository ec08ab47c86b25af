"""The handlers of a program: how they are registered, what they get, and how they are called.

What can't work is an error at once, with the line of the user's code. A handler may be sync or async; a sync one runs
in a thread of its own, so that it may block. `Job` is what the handlers of a job see of it, `TopicHandlers` converts
the messages of its objective to the types that they take, and `Handlers` has all that one agent was given.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import sys
import time
import types
import weakref
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from mesh.base.background import call_in_loop, in_daemon_thread
from mesh.base.log_context import log_event
from mesh.errors import AiraError, ClosedError, ConfigurationError, InputError
from mesh.network import sending
from mesh.recording import encode_described
from schemas import Demand, Liability, Offer, Result, Verified
from schemas.address import is_ens_name
from schemas.cid import is_cid
from schemas.errors import InvalidKey, InvalidPayload
from schemas.keys import LiabilityTopicKey, topic_chunks
from schemas.payloads import Empty, PayloadType, SentDefinitions, String, decode_value, payload_type, plain_value
from schemas.signing import LONGEST_DETAIL, is_word

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from types import FrameType

    import zenoh

    from mesh.agent.ledger import Phase
    from mesh.network import Reading, ReadingSubscription, Subscription
    from mesh.recording import Played
    from schemas.rpc import QuoteRequest
    from schemas.verdicts import ValidatorReport

    TopicHandler = Callable[["Job", Any], object]


_OURS: Final = frozenset({"mesh", "schemas", "bridges"})
"""The packages whose code is not the user's."""


class RegistrationError(ConfigurationError, code="registration-error"):
    """A program gives its agent something that can't work. `file` and `line` say where in the program."""

    def __init__(self, why: str, *, hint: str = "", code: str = "") -> None:
        frame = user_frame()
        self.file, self.line = frame.f_code.co_filename, frame.f_lineno
        path = Path(self.file)
        shown = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
        super().__init__(f"{shown}:{self.line}: {why}", hint=hint, code=code)


def check_handler(handler: Any, wanted: str, *, arguments: int) -> None:
    """Raise `RegistrationError` unless `handler` can be called with that many arguments, which `wanted` names."""
    name = name_of(handler)
    why, hint = "", f"write `async def {name}({wanted})`, or without `async`"
    if not callable(handler):
        why, hint = f"{handler!r} is not a function", "write the decorator above a function"
    for checked in (handler, getattr(handler, "__call__", None)):  # noqa: B004
        if inspect.isgeneratorfunction(checked) or inspect.isasyncgenfunction(checked):
            why = f"the handler {name} is a generator: nothing would run it"
    if not why:
        try:
            inspect.signature(handler).bind(*[None] * arguments)
        except TypeError as error:
            why = f"the handler {name} must take ({wanted}): {error}"
        except ValueError:
            return  # a function without a signature, written in C
    if why:
        raise RegistrationError(why, hint=hint, code="invalid-handler")


def name_of(handler: Any) -> str:
    return str(getattr(handler, "__name__", None) or type(handler).__name__)


def user_frame() -> FrameType:
    """The innermost frame of the user's code: the first one outside of our packages."""
    frame = sys._getframe(1)
    while (caller := frame.f_back) and frame.f_globals.get("__name__", "").partition(".")[0] in _OURS:
        frame = caller
    return frame


async def call_handler(handler: Callable[..., object], *arguments: Any) -> Any:
    """Call a handler, a sync one in a thread; returns what it returns. Raises what it raises.

    Cancelling stops an async handler; a sync one continues in its thread, and nothing waits for it.
    """
    if inspect.iscoroutinefunction(inspect.unwrap(handler)):
        outcome = handler(*arguments)
    else:
        outcome = await asyncio.wrap_future(
            in_daemon_thread(partial(handler, *arguments), f"handler {name_of(handler)}")
        )
    return await outcome if inspect.isawaitable(outcome) else outcome


class HandlerLimits(NamedTuple):
    """What may wait for one handler; beyond, the oldest messages are left out."""

    messages: int = 1024
    """Messages."""
    size: int = 8 << 20
    """Bytes of their payloads."""


HANDLER_LIMITS: Final = HandlerLimits()


class JobMessages:
    """The values on a topic of a job since `Job.listen`, in order; iteration ends with the job.

    If too many wait, the oldest are left out, and counted in `dropped`. For one consumer.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.dropped = 0
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[bytes, PayloadType]] = deque()
        self._bytes = 0
        self._ended = False
        self._changed = asyncio.Event()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        while True:
            while self._waiting:
                payload, kind = self._take()
                try:
                    return plain_value(payload, kind)
                except InvalidPayload:
                    continue  # the recording has it; a handler can't use it
            if self._ended:
                raise StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()

    def deliver(self, payload: bytes, kind: PayloadType) -> None:
        """Add a message. For any thread."""
        call_in_loop(self._loop, self._add, payload, kind)

    def end(self) -> None:
        """End the iteration after what waits. For any thread."""
        call_in_loop(self._loop, self._end)

    def _add(self, payload: bytes, kind: PayloadType) -> None:
        self._waiting.append((payload, kind))
        self._bytes += len(payload)
        limits = HANDLER_LIMITS
        while len(self._waiting) > limits.messages or (self._bytes > limits.size and len(self._waiting) > 1):
            self._take()
            self.dropped += 1
        self._changed.set()

    def _take(self) -> tuple[bytes, PayloadType]:
        payload, kind = self._waiting.popleft()
        self._bytes -= len(payload)
        return payload, kind

    def _end(self) -> None:
        self._ended = True
        self._changed.set()


STOPPING: Final = ContextVar("stopping", default="")
"""The job that the running code, a handler of `Agent.on_stop`, brings to a safe state."""


class Declined(AiraError, code="declined"):
    """Raise it in a demand's handler: the agent does not work for this demand, and its maker gets a `Decline`.

    `reason` is a word for programs (`too-cheap`: lower-case letters, digits, hyphens), `detail` a line for people, cut
    after `LONGEST_DETAIL` characters. Raises `InputError` for another word.
    """

    def __init__(self, reason: str, detail: str = "") -> None:
        if not is_word(reason):
            raise InputError(f"{reason!r} is not a valid code", hint="use lower-case letters, digits and hyphens")
        super().__init__(f"declined ({reason}): {detail}" if detail else f"declined ({reason})")
        self.reason = reason
        self.detail = detail[:LONGEST_DETAIL]


class JobFailed(AiraError, code="job-failed"):
    """Raise it in a handler to end the job without success, which refunds the promisee. The text says why."""


class Job:
    """The work for one liability, as its handlers see it."""

    def __init__(self, session: zenoh.Session, agent: str, liability: Liability, *, position: int = 0) -> None:
        self._session = session
        self._agent = agent
        self._types: dict[tuple[str, str], PayloadType] = {}
        self._definitions = SentDefinitions()
        self._subscriber: Any = None
        self._listening: tuple[weakref.ref[JobMessages], ...] = ()
        self.liability = liability
        """The contract that this job is for."""
        self.topics: frozenset[str] = frozenset()
        """The topics of its objective."""
        self.position = position
        """How many of the objective's messages have been handled."""
        self.playing: Played | None = None
        """The message that is being handled: its topic, times and type."""
        self.stopped = False
        """Whether it was stopped. A sync handler, which nothing can cancel, looks at it and returns."""

    def __repr__(self) -> str:
        return f"Job({self.liability.address}, position={self.position}, topics={sorted(self.topics)})"

    async def _handle_one(self, handle: Callable[[Job, Played], Awaitable[object]], message: Played) -> None:
        """Await the handler of a played message. Raises what it raises, and for one that was cancelled `AiraError`."""
        try:
            await handle(self, message)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            # A task group would take this task for one that it cancelled itself, and the job for done.
            raise AiraError(f"the handler of {message.topic} was cancelled", code="handler-cancelled") from None

    def publish(self, topic: str, message: object) -> None:
        """Publish on a topic of the job, as a device does. The message becomes part of the recording.

        `message` is a number, a bool, a str, bytes, None, a list, a dict, a msgspec Struct, a dataclass, `Empty`,
        `String`, a number or array of numpy, or a `Payload`. Raises `InvalidPayload` for anything else (also for NaN in
        a dict or Struct, which become JSON), and `ClosedError` before the job runs, and after it has ended or was
        stopped.
        """
        self._check_running()
        payload, kind = encode_described(message)
        key = str(LiabilityTopicKey(self._agent, self.liability.address, topic))
        attachment = None
        if payload_type(kind.zenoh_encoding) != kind:  # the name alone does not say what it is
            self._types[topic, kind.zenoh_encoding] = kind
            attachment = self._definitions.attachment(b"", key, kind, time.monotonic()) or None
        self._put(key, payload, kind, attachment)

    def listen(self, topic: str) -> JobMessages:
        """What is published on a topic of the job from now on: `async for message in job.listen("/measurements")`.

        That is what a device says, decoded (a `str` for a text), and what `publish` puts there. The iteration ends with
        the job. Raises `InvalidKey` for an invalid topic, and `ClosedError` before the job runs and after it has ended.
        """
        self._check_running()
        messages = JobMessages(topic_chunks(topic))
        self._listening = (*(one for one in self._listening if one() is not None), weakref.ref(messages))
        return messages

    def _deliver(self, topic: str, payload: bytes, kind: PayloadType) -> None:
        """Pass a received message on to those who listen to its topic. On any thread."""
        for reference in self._listening:
            if (messages := reference()) is not None and messages.topic == topic:
                messages.deliver(payload, kind)

    def _end_listening(self) -> None:
        for reference in self._listening:
            if (messages := reference()) is not None:
                messages.end()

    def _check_running(self) -> None:
        if self._subscriber is None:
            raise ClosedError(f"the job {self.liability.address} is not running")
        if self.stopped and STOPPING.get() != self.liability.address:
            raise ClosedError(f"the job {self.liability.address} was stopped")

    def _put(self, key: str, payload: bytes, kind: PayloadType, attachment: bytes | None = None) -> None:
        sending.put(self._session, key, payload, encoding=kind.zenoh_encoding, attachment=attachment)


ANY_TOPIC: Final = "*"
"""The topic of the handler for topics without a handler of their own."""
K = TypeVar("K")

_NATIVE: Final = (Empty, String, bytes)
"""What payloads decode to, and no JSON is converted to."""
_ANYTHING: Final = (Any, object, inspect.Parameter.empty)


@dataclass(frozen=True)
class TypedHandler:
    """A handler, and the type of the messages that it takes: of its second argument, or given where it is registered.

    `declared` is that type, `Any` for messages of any type.
    """

    handler: TopicHandler
    declared: Any
    _native: tuple[type, ...] = ()
    _converted: Any = None

    def convert(self, value: Any) -> Any:
        """A decoded message as this type. Raises `InvalidPayload`."""
        if self.declared is Any or isinstance(value, self._native):
            return value
        if self._converted is None or (isinstance(value, _NATIVE) and not isinstance(value, String)):
            raise InvalidPayload(_text(self.declared), f"it is {_described(value)}")
        plain = value.data if isinstance(value, String) else value
        try:
            return msgspec.convert(plain, self._converted)
        except msgspec.ValidationError as error:
            with suppress(msgspec.ValidationError):
                return msgspec.convert(_whole(plain), self._converted)
            raise InvalidPayload(_text(self.declared), str(error)) from None


class ObjectiveMessages(tuple[tuple[str, Any], ...]):
    """The messages of an objective by time: each with its topic, and as the type that its handler takes."""

    __slots__ = ()

    def of(self, kind: type[K]) -> list[K]:
        """Those of one type: `sum(move.meters for move in messages.of(Move))`."""
        return [value for _, value in self if isinstance(value, kind)]


class TopicHandlers:
    """The functions that handle what objectives play, by topic."""

    def __init__(self) -> None:
        self._handlers: dict[str, TypedHandler] = {}

    def add(self, topic: str, handler: TopicHandler, kind: Any = None) -> None:
        """Register the handler of a topic (`*`: of all others).

        Its messages are converted to `kind`, by default the type that the handler's second argument has. Raises
        `RegistrationError`.
        """
        check_topic(topic)
        if topic in self._handlers:
            why = f"two handlers for topic {topic}"
            raise RegistrationError(why, hint="give each topic one handler", code="duplicate-handler")
        check_handler(handler, "job: Job, message", arguments=2)
        declared = _declared(handler) if kind is None else kind
        self._handlers[topic] = _typed(handler, declared)

    def __bool__(self) -> bool:
        return bool(self._handlers)

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics that have a handler; None if any topic has one."""
        return None if ANY_TOPIC in self._handlers else frozenset(self._handlers)

    @property
    def declared(self) -> Mapping[str, Any]:
        """The type of messages that each topic's handler declares (`Any` if it declares none), in order."""
        return {topic: found.declared for topic, found in self._handlers.items()}

    def obstacle(self, topic: str, value: Any) -> str:
        """Why the handler of a topic can't take a decoded message; empty if it can."""
        if (found := self.find(topic)) is not None:
            try:
                found.convert(value)
            except InvalidPayload as error:
                return str(error)
        return ""

    def typed(self, messages: Iterable[Played]) -> ObjectiveMessages:
        """What these handlers would get of messages that were examined: each as its handler's type."""
        typed = []
        for message in messages:
            value = decode_value(message.payload, message.type)
            found = self.find(message.topic)
            typed.append((message.topic, value if found is None else found.convert(value)))
        return ObjectiveMessages(typed)

    async def handle(self, job: Job, message: Played) -> None:
        """Decode a played message and await its handler. Raises what the handler raises, and `JobFailed`."""
        found = self.find(message.topic)
        assert found is not None, "objectives with other topics are refused before they are played"
        try:
            value = found.convert(decode_value(message.payload, message.type))
        except InvalidPayload as error:
            raise JobFailed(f"a message on {message.topic} is {error}") from None
        await call_handler(found.handler, job, value)

    def find(self, topic: str) -> TypedHandler | None:
        """The handler of a topic; None if no message on it is handled."""
        return self._handlers.get(topic) or self._handlers.get(ANY_TOPIC)


def check_topic(topic: object) -> None:
    """Raise `RegistrationError` for what no handler can be registered for."""
    if not isinstance(topic, str):
        raise invalid_topic(topic, "it is no text")
    if topic != ANY_TOPIC:
        try:
            topic_chunks(topic)
        except InvalidKey as error:
            raise invalid_topic(topic, error.why) from None


def invalid_topic(topic: object, why: str) -> RegistrationError:
    """The error of a handler for what is no topic."""
    hint = 'a topic is like "/blink"; "*" stands for all others'
    return RegistrationError(f"{topic!r} is not a topic: {why}", hint=hint, code="invalid-topic")


def _invalid_type(handler: TopicHandler, why: str) -> RegistrationError:
    """The error of a handler that declares a type to which no message can be decoded."""
    hint = "use a msgspec Struct, a dataclass, float, int, bool, str, bytes, Empty, String, list or dict"
    why = f"the handler {name_of(handler)} can't get messages: {why}"
    return RegistrationError(why, hint=hint, code="invalid-message-type")


def _declared(handler: Any) -> Any:
    """The type of a handler's second argument. Raises `RegistrationError` for an annotation that can't be read."""
    function = inspect.unwrap(getattr(handler, "func", handler))  # of a `partial`
    try:
        annotation = list(inspect.signature(handler).parameters.values())[1].annotation
    except (ValueError, IndexError):  # written in C, or with *args
        return Any
    source = getattr(function, "__globals__", None) or getattr(type(function).__call__, "__globals__", {})
    scope = {**user_frame().f_locals, **source}

    def holder() -> None: ...

    holder.__annotations__ = {"message": annotation}  # only this one: that of the job may be for type checkers only
    try:
        return get_type_hints(holder, scope, include_extras=True)["message"]
    except Exception as error:
        why = f"its annotation {annotation!r} can't be read ({error}); import the type outside of `if TYPE_CHECKING`"
        raise _invalid_type(handler, why) from None


def _typed(handler: TopicHandler, declared: Any) -> TypedHandler:
    """Raises `RegistrationError` for a type that no message can be decoded to."""
    if declared in _ANYTHING:
        return TypedHandler(handler, Any)
    is_union = get_origin(declared) in (Union, types.UnionType)
    members = get_args(declared) if is_union else (declared,)
    native = tuple(one for one in members if one in _NATIVE)
    others = [one for one in members if one not in _NATIVE]
    converted = Union[tuple(others)] if others else None  # noqa: UP007
    try:
        unknown = next(_undecodable(msgspec.inspect.type_info(converted)), None) if others else None
    except (TypeError, NameError) as error:
        raise _invalid_type(handler, str(error)) from None
    if unknown is not None:
        raise _invalid_type(handler, f"no message can be decoded to {_text(unknown)}")
    return TypedHandler(handler, declared, native, converted)


def _undecodable(info: msgspec.inspect.Type) -> Iterator[type]:
    """The types in a type that msgspec knows nothing of."""
    pending, seen = [info], set[int]()
    while pending:
        node = pending.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, msgspec.inspect.CustomType):
            yield node.cls
        for value in msgspec.structs.astuple(node):
            for one in value if isinstance(value, tuple) else (value,):
                inner = one.type if isinstance(one, msgspec.inspect.Field) else one
                if isinstance(inner, msgspec.inspect.Type):
                    pending.append(inner)


def _whole(value: Any) -> Any:
    """Data with each float that is an integer as an int: for JSON Schema, 5.0 is an integer."""
    match value:
        case float() if value.is_integer():
            return int(value)
        case list():
            return [_whole(one) for one in value]
        case dict():
            return {name: _whole(one) for name, one in value.items()}
    return value


def _text(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _described(value: object) -> str:
    return f"{len(value)} bytes" if isinstance(value, bytes) else f"a {type(value).__name__}"


log = logging.getLogger(__name__)

Handler = Callable[..., object]
DemandHandler = Callable[[Verified[Demand]], object]
OfferHandler = Callable[[Verified[Offer]], object]
ResultHandler = Callable[[Verified[Result]], object]
LiabilityHandler = Callable[["Phase", Liability], object]
ReadingHandler = Callable[["Reading"], object]
ReportHandler = Callable[["ValidatorReport"], object]
PeriodicHandler = Callable[[], object]
QuoteHandler = Callable[["QuoteRequest"], object]
StopHandler = Callable[[Job, str], object]


def check_period(seconds: object) -> None:
    """Raise `RegistrationError` for what is no positive number of seconds."""
    if not isinstance(seconds, int | float) or not 0 < seconds < math.inf:
        why = f"{seconds!r} is not a number of seconds above 0"
        raise RegistrationError(why, hint="write @agent.every(5.0)", code="invalid-period")


def check_parallel(parallel: object) -> None:
    """Raise `RegistrationError` for what is no number of jobs."""
    if not isinstance(parallel, int) or parallel < 1:
        why = f"{parallel!r} is not a number of jobs from 1 on"
        raise RegistrationError(why, hint="write Agent(…, parallel=2)", code="invalid-parallel")


def check_model(model: object) -> None:
    """Raise `RegistrationError` for what is neither a CID, an ENS name nor a path. Empty stands for any model."""
    if isinstance(model, Path) or (isinstance(model, str) and (not model or is_ens_name(model) or is_cid(model))):
        return
    hint = 'the CID of a file is cid_of_file("model.md"), or what `aira cid model.md` prints'
    why = f"the model {str(model)[:80]!r} is neither a CID nor an ENS name"
    raise RegistrationError(why, hint=hint, code="invalid-model")


@dataclass
class Handlers:
    topics: TopicHandlers = field(default_factory=TopicHandlers)
    """`topics.declared` has the type of each topic's messages."""
    market: dict[type[Demand | Offer | Result], list[Handler]] = field(default_factory=dict)
    liabilities: list[LiabilityHandler] = field(default_factory=list)
    reports: list[ReportHandler] = field(default_factory=list)
    quotes: list[QuoteHandler] = field(default_factory=list)
    stops: list[StopHandler] = field(default_factory=list)
    readings: list[tuple[str, str, ReadingHandler]] = field(default_factory=list)
    """The topic, the agent (`*` for any), and the handler."""
    periodic: list[tuple[float, PeriodicHandler]] = field(default_factory=list)


async def call(
    handler: Handler, *arguments: Any, logged: Callable[[AiraError], bool] = lambda _error: True
) -> AiraError | None:
    """Call a handler that belongs to no job. If it fails, that is logged (an `AiraError` if `logged` says so).

    The agent continues. Returns the `AiraError`.
    """
    name = name_of(handler)
    try:
        await call_handler(handler, *arguments)
    except AiraError as error:
        if logged(error):
            log.warning("handler %s: %s", name, error, extra=log_event("handler-failed", handler=name, code=error.code))
        return error
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        message = "handler %s was cancelled by what it waited for; the agent continues"
        log.error(message, name, extra=log_event("handler-cancelled", handler=name))
    except Exception as error:
        facts = log_event("handler-crashed", handler=name, error=type(error).__name__)
        log.exception("handler %s failed; the agent continues", name, extra=facts)
    return None


async def dispatch(
    subscription: Subscription[Any] | ReadingSubscription, handlers: Sequence[Handler], *, concurrency: int
) -> None:
    """Call all handlers with each message, one at a time; up to `concurrency` messages at once."""
    slots = asyncio.Semaphore(concurrency)

    async def handle(message: Any) -> None:
        try:
            for handler in handlers:
                await call(handler, message)
        finally:
            slots.release()

    async with asyncio.TaskGroup() as tasks:
        async for message in subscription:
            await slots.acquire()
            tasks.create_task(handle(message), name="handler")


async def repeat(seconds: float, handler: PeriodicHandler) -> None:
    """Call a handler, then wait `seconds`, until cancelled."""
    while True:
        await call(handler)
        await asyncio.sleep(seconds)

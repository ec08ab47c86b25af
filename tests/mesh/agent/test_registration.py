"""Registering handlers: the types of their messages, sync and async, and every mistake at once with its line."""

from __future__ import annotations

import asyncio
import functools
import threading
from contextvars import ContextVar
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import pytest

from mesh import Agent, Settings
from mesh.agent.handlers import (
    Job,
    JobFailed,
    RegistrationError,
    TopicHandlers,
    call,
    call_handler,
)
from mesh.recording import Played
from schemas import Empty, InvalidPayload, String
from schemas.payloads import encode_value
from tests.support.market import MODEL
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

CURRENT: ContextVar[str] = ContextVar("current")


class Move(msgspec.Struct):
    metres: float


class Steps(msgspec.Struct):
    count: int
    speed: float


@dataclass
class Turn:
    degrees: Annotated[float, msgspec.Meta(ge=0, le=360)]


class Colour(Enum):
    RED = "red"


class Unknown:
    pass


async def taken(annotation: Any, value: object) -> Any:
    """What a handler whose message has this annotation gets for a published value."""
    handlers, got = TopicHandlers(), list[Any]()

    async def handler(job: Job, message: object) -> None:
        got.append(message)

    handler.__annotations__["message"] = annotation
    handlers.add("/a", handler)
    payload, kind = encode_value(value)
    await handlers.handle(None, Played("/a", payload, 0, 0, 0, kind))  # type: ignore[arg-type]
    return got[0]


@pytest.mark.parametrize(
    ("annotation", "value", "expected"),
    [
        (Move, {"metres": 1}, Move(1.0)),
        ("Move", {"metres": 1}, Move(1.0)),
        (Turn, {"degrees": 90}, Turn(90.0)),
        (float, 1.5, 1.5),
        (float, 2, 2.0),
        (int, 2, 2),
        (int, 5.0, 5),
        (list[int], [1.0, 2.0], [1, 2]),
        (Steps, {"count": 3.0, "speed": 2.0}, Steps(3, 2.0)),
        (bool, True, True),
        (str, "blue", "blue"),
        (str, String("blue"), "blue"),
        (String, "blue", String("blue")),
        (bytes, b"\0\1", b"\0\1"),
        (Empty, Empty(), Empty()),
        (list[float], [1, 2.5], [1.0, 2.5]),
        (dict[str, int], {"a": 1}, {"a": 1}),
        (dict, {"a": [1, None]}, {"a": [1, None]}),
        (Colour, "red", Colour.RED),
        (Literal["red", "blue"], "blue", "blue"),
        (float | str, "fast", "fast"),
        (Empty | String, Empty(), Empty()),
        (Move | Empty, {"metres": 2}, Move(2.0)),
        (Any, "blue", String("blue")),
        (object, {"a": 1}, {"a": 1}),
    ],
)
async def test_a_message_has_the_type_that_the_handler_declares(annotation: Any, value: object, expected: Any) -> None:
    message = await taken(annotation, value)
    assert (type(message), message) == (type(expected), expected)


@pytest.mark.parametrize(
    ("annotation", "value"),
    [
        (Move, {"metres": "far"}),
        (Turn, {"degrees": 361}),
        (float, "fast"),
        (int, True),
        (int, 5.5),
        (int, inf),
        (str, 5),
        (bytes, "blue"),
        (Empty, "blue"),
        (String, Empty()),
        (float, b"\0\1"),
        (Colour, "green"),
    ],
)
async def test_a_message_of_another_type_is_unfit(annotation: Any, value: object) -> None:
    with pytest.raises(JobFailed):
        await taken(annotation, value)


async def test_the_type_at_the_registration_goes_before_the_annotation() -> None:
    handlers = TopicHandlers()
    handlers.add("/a", lambda job, message: None, Move)
    assert handlers.declared == {"/a": Move}
    assert handlers.obstacle("/a", {"metres": 1}) == ""
    assert handlers.obstacle("/a", {"feet": 1}) != ""


def test_declared_types_are_read_from_methods_partials_local_classes_and_objects() -> None:
    class Local(msgspec.Struct):
        x: int

    class Robot:
        def move(self, job: Job, message: Move) -> None: ...

        async def __call__(self, job: Job, message: Turn) -> None: ...

    def with_speed(speed: float, job: Job, message: Local) -> None: ...

    def wrapped(handler: Callable[[Job, Any], object]) -> Callable[[Job, Any], object]:
        return functools.wraps(handler)(lambda job, message: handler(job, message))

    def untyped(job, message): ...  # type: ignore[no-untyped-def]

    handlers = TopicHandlers()
    handlers.add("/method", Robot().move)
    handlers.add("/object", Robot())
    handlers.add("/partial", functools.partial(with_speed, 1.0))
    handlers.add("/wrapped", wrapped(Robot().move))
    handlers.add("/untyped", untyped)
    assert handlers.declared == {
        "/method": Move,
        "/object": Turn,
        "/partial": Local,
        "/wrapped": Move,
        "/untyped": Any,
    }


async def test_a_sync_handler_runs_in_a_thread_with_its_context_and_may_block() -> None:
    seen: list[tuple[bool, str]] = []
    release = threading.Event()

    def slow(number: int) -> None:
        seen.append((threading.current_thread() is threading.main_thread(), CURRENT.get()))
        release.wait(60)

    CURRENT.set("0x1")
    busy = [asyncio.create_task(call_handler(slow, number)) for number in range(64)]  # more than asyncio has threads
    while len(seen) < 64:
        await asyncio.sleep(0.01)
    release.set()
    await asyncio.gather(*busy)
    assert seen == [(False, "0x1")] * 64


async def test_what_a_sync_handler_raises_reaches_the_caller() -> None:
    def fail() -> None:
        raise JobFailed("no")

    def stop() -> None:
        next(iter(()))

    with pytest.raises(JobFailed):
        await call_handler(fail)
    with pytest.raises(RuntimeError):
        await call_handler(stop)
    error = await call(fail)
    assert error is not None
    assert error.code == "job-failed"


async def test_a_sync_function_may_return_a_coroutine() -> None:
    done: list[int] = []

    async def handle(number: int) -> None:
        done.append(number)

    await call_handler(lambda: handle(1))
    await call_handler(functools.partial(handle, 2))
    assert done == [1, 2]


async def test_nobody_waits_for_a_cancelled_sync_handler() -> None:
    release = threading.Event()
    task = asyncio.create_task(call_handler(release.wait, 60))
    await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    release.set()


def agent() -> Agent:
    return Agent(settings=Settings())


def nothing() -> None: ...


def job_and_message(job: Job, message: object) -> None: ...


def only_job(job: Job) -> None: ...


def generator(job: Job, message: object) -> Iterator[int]:
    yield 1


async def async_generator(job: Job, message: object) -> AsyncIterator[int]:
    yield 1


def of_unknown(job: Job, message: list[Unknown]) -> None: ...


def of_two(job: Job, message: Move | Turn) -> None: ...


def of_nobody(job: Job, message: Nobody) -> None: ...  # type: ignore[name-defined]  # noqa: F821


MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "model": (lambda: Agent("model.md", settings=Settings()), "invalid-model"),
    "bytes": (lambda: Agent(b"model.md", settings=Settings()), "invalid-model"),  # type: ignore[arg-type]
    "topic": (lambda: agent().on("blink"), "invalid-topic"),
    "selector": (lambda: agent().on("/blink/**"), "invalid-topic"),
    "no topic": (lambda: agent().on(job_and_message), "invalid-topic"),  # type: ignore[call-overload]
    "no function": (lambda: agent().on("/a")("text"), "invalid-handler"),  # type: ignore[type-var]
    "arity": (lambda: agent().on("/a")(only_job), "invalid-handler"),  # type: ignore[type-var]
    "generator": (lambda: agent().on("/a")(generator), "invalid-handler"),
    "async generator": (lambda: agent().on("/a")(async_generator), "invalid-handler"),
    "demand": (lambda: agent().on_demand(job_and_message), "invalid-handler"),  # type: ignore[type-var]
    "offer": (lambda: agent().on_offer(nothing), "invalid-handler"),  # type: ignore[type-var]
    "result": (lambda: agent().on_result(nothing), "invalid-handler"),  # type: ignore[type-var]
    "liability": (lambda: agent().on_liability(only_job), "invalid-handler"),  # type: ignore[type-var]
    "reading": (lambda: agent().on_reading("battery"), "invalid-topic"),
    "reading's agent": (lambda: agent().on_reading("/a", agent="0x1"), "registration-error"),
    "on reading": (lambda: agent().on_reading("/a")(nothing), "invalid-handler"),  # type: ignore[type-var]
    "every": (lambda: agent().every(1.0)(only_job), "invalid-handler"),  # type: ignore[type-var]
    "every 0": (lambda: agent().every(0), "invalid-period"),
    "every -1": (lambda: agent().every(-1.0), "invalid-period"),
    "every nan": (lambda: agent().every(float("nan")), "invalid-period"),
    "every text": (lambda: agent().every("1"), "invalid-period"),  # type: ignore[arg-type]
    "unknown type": (lambda: agent().on("/a")(of_unknown), "invalid-message-type"),
    "ambiguous": (lambda: agent().on("/a")(of_two), "invalid-message-type"),
    "no such name": (lambda: agent().on("/a")(of_nobody), "invalid-message-type"),
    "unknown kind": (lambda: agent().on("/a", Unknown)(job_and_message), "invalid-message-type"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_an_error_with_the_line_of_the_program(name: str) -> None:
    mistake, code = MISTAKES[name]
    with raises_with(RegistrationError, code=code) as caught:
        mistake()
    error = caught.value
    assert (error.file, error.line) == (__file__, mistake.__code__.co_firstlineno)
    assert f"test_registration.py:{error.line}: " in str(error)
    assert error.hint


def test_the_line_of_a_decorated_handler_is_that_of_its_decorator() -> None:
    robot = agent()
    robot.on("/a")(job_and_message)

    def decorate() -> None:
        @robot.on("/a")
        def again(job: Job, message: object) -> None: ...

    with raises_with(RegistrationError, code="duplicate-handler", match="topic /a") as caught:
        decorate()
    assert caught.value.line == decorate.__code__.co_firstlineno + 1


@pytest.mark.parametrize("model", ["", "blink.model.5.robonomics.eth", MODEL])
def test_a_model_is_a_cid_a_name_or_nothing(model: str) -> None:
    assert Agent(model, settings=Settings()).model == model


def test_an_unfit_value_says_why() -> None:
    handlers = TopicHandlers()
    handlers.add("/a", job_and_message, Move)
    with pytest.raises(InvalidPayload) as caught:
        handlers._handlers["/a"].convert([1])
    assert caught.value.type_name == "Move"

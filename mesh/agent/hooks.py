"""What a user's code hangs on an agent: handlers, by what they wait for."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import msgspec

from mesh.agent.errors import JobFailed
from mesh.errors import AiraError
from schemas.errors import InvalidPayload
from schemas.payloads import decode_value

if TYPE_CHECKING:
    from mesh.recording import Played
    from mesh.work.job import Job
    from schemas import Demand, Offer, Result

log = logging.getLogger(__name__)

Handler = Callable[..., Awaitable[Any]]

ANY_TOPIC: Final = "*"
"""The topic of the handler that takes what no other does."""


@dataclass
class Hooks:
    """The handlers of one agent."""

    topics: dict[str, tuple[Handler, type | None]] = field(default_factory=dict)
    market: dict[type[Demand | Offer | Result], list[Handler]] = field(default_factory=dict)
    liabilities: list[Handler] = field(default_factory=list)
    periodic: list[tuple[float, Handler]] = field(default_factory=list)


class HandlerTopics:
    """Does a job by handing each played message to the handler of its topic."""

    def __init__(self, hooks: Hooks) -> None:
        self._hooks = hooks

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics that have a handler; None if there is one for any."""
        return None if ANY_TOPIC in self._hooks.topics else frozenset(self._hooks.topics)

    def obstacle(self, topic: str, said: Any) -> str:
        """Why the handler of a topic can't be given what a message says, decoded; empty if it can."""
        hook = self._hook(topic)
        try:
            if hook is not None:
                _typed(said, hook[1])
        except InvalidPayload as error:
            return str(error)
        return ""

    async def perform(self, run: Job, message: Played) -> None:
        """Decode the message and wait for its handler."""
        hook = self._hook(message.topic)
        assert hook is not None, "preflight lets no other topic pass"
        handler, kind = hook
        try:
            typed = _typed(decode_value(message.payload, message.type), kind)
        except InvalidPayload as error:
            raise JobFailed(f"a message on {message.topic} is {error}") from None
        await handler(run, typed)

    def _hook(self, topic: str) -> tuple[Handler, type | None] | None:
        return self._hooks.topics.get(topic) or self._hooks.topics.get(ANY_TOPIC)


def _typed(said: Any, kind: type | None) -> Any:
    """What a handler gets: what a message says, brought to the type that the handler was registered for.

    Raises `InvalidPayload`.
    """
    if kind is None or isinstance(said, kind):
        return said
    try:
        return msgspec.convert(said, kind)
    except msgspec.ValidationError as error:
        raise InvalidPayload(kind.__name__, str(error)) from None


async def call(handler: Handler, *arguments: Any) -> None:
    """Call a handler that no job depends on; its failure is logged, and the agent goes on."""
    name = getattr(handler, "__name__", handler)
    try:
        await handler(*arguments)
    except AiraError as error:
        log.warning("handler %s: %s", name, error)
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        log.error("handler %s ended with the cancellation of what it waited for; the agent goes on", name)
    except Exception:
        log.exception("handler %s failed; the agent goes on", name)


async def hear(subscription: Any, handlers: list[Handler], *, at_once: int) -> None:
    """Hand each message to all handlers in turn; so many messages at once."""
    turns = asyncio.Semaphore(at_once)

    async def handle(message: Any) -> None:
        try:
            for handler in handlers:
                await call(handler, message)
        finally:
            turns.release()

    async with asyncio.TaskGroup() as tasks:
        async for message in subscription:
            await turns.acquire()
            tasks.create_task(handle(message), name="handler")


async def repeat(seconds: float, handler: Handler) -> None:
    """Call the handler every so many seconds, until cancelled."""
    while True:
        await call(handler)
        await asyncio.sleep(seconds)

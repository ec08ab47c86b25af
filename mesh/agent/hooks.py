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
from schemas.values import decode_value

if TYPE_CHECKING:
    from mesh.recording import Played
    from mesh.work.run import Run
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


class HandlerPerformer:
    """Does a job by handing each played message to the handler of its topic."""

    def __init__(self, hooks: Hooks) -> None:
        self._hooks = hooks

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics that have a handler; None if there is one for any."""
        return None if ANY_TOPIC in self._hooks.topics else frozenset(self._hooks.topics)

    async def perform(self, run: Run, message: Played) -> None:
        """Decode the message and wait for its handler."""
        handler, kind = self._hooks.topics.get(message.topic) or self._hooks.topics[ANY_TOPIC]
        await handler(run, _typed(message, kind))


def _typed(message: Played, kind: type | None) -> Any:
    """What a handler gets: the decoded payload, brought to the type that it was registered for."""
    decoded = decode_value(message.payload, message.type)
    if kind is None or isinstance(decoded, kind):
        return decoded
    try:
        return msgspec.convert(decoded, kind)
    except msgspec.ValidationError as error:
        raise JobFailed(f"a message on {message.topic} is no {kind.__name__}: {error}") from None


async def call(handler: Handler, *arguments: Any) -> None:
    """Call a handler that no job depends on; its failure is logged, and the agent goes on."""
    name = getattr(handler, "__name__", handler)
    try:
        await handler(*arguments)
    except AiraError as error:
        log.warning("%s: %s", name, error)
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        log.error("handler %s ended with the cancellation of what it waited for; the agent goes on", name)
    except Exception:
        log.exception("handler %s failed; the agent goes on", name)

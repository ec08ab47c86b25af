"""The handlers of an agent: which it has, and how those that belong to no job are called."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, overload

from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.work.job import TopicHandlers
from schemas import Demand, Liability, Offer, Result, Verified, reading_selector

if TYPE_CHECKING:
    from mesh.network import Reading, ReadingSubscription, Subscription
    from mesh.work.job import Job
    from mesh.work.ledger import Phase

log = logging.getLogger(__name__)

Handler = Callable[..., Awaitable[object]]
DemandHandler = Callable[[Verified[Demand]], Awaitable[object]]
OfferHandler = Callable[[Verified[Offer]], Awaitable[object]]
ResultHandler = Callable[[Verified[Result]], Awaitable[object]]
LiabilityHandler = Callable[["Phase", Liability], Awaitable[object]]
ReadingHandler = Callable[["Reading"], Awaitable[object]]
PeriodicHandler = Callable[[], Awaitable[object]]


@dataclass
class Handlers:
    """The handlers of one agent."""

    topics: TopicHandlers = field(default_factory=TopicHandlers)
    market: dict[type[Demand | Offer | Result], list[Handler]] = field(default_factory=dict)
    liabilities: list[LiabilityHandler] = field(default_factory=list)
    readings: list[tuple[str, str, ReadingHandler]] = field(default_factory=list)
    """The topic, the agent (`*` for any), and the handler."""
    periodic: list[tuple[float, PeriodicHandler]] = field(default_factory=list)


D = TypeVar("D", bound=DemandHandler)
O = TypeVar("O", bound=OfferHandler)  # noqa: E741
R = TypeVar("R", bound=ResultHandler)
L = TypeVar("L", bound=LiabilityHandler)
G = TypeVar("G", bound=ReadingHandler)
P = TypeVar("P", bound=PeriodicHandler)
K = TypeVar("K")


class HandlerDecorators:
    """The decorators of an `Agent`, which register handlers."""

    def __init__(self) -> None:
        self._handlers = Handlers()

    @overload
    def on(
        self, topic: str
    ) -> Callable[[Callable[[Job, Any], Awaitable[object]]], Callable[[Job, Any], Awaitable[object]]]: ...

    @overload
    def on(
        self, topic: str, kind: type[K]
    ) -> Callable[[Callable[[Job, K], Awaitable[object]]], Callable[[Job, K], Awaitable[object]]]: ...

    def on(self, topic: str, kind: type | None = None) -> Callable[[Any], Any]:
        """Handle what objectives play on `topic` (`*`: on topics without a handler): `async def handler(job, message)`.

        `message` is decoded (`Empty`, `String`, JSON data, or bytes), or converted to `kind`, a msgspec Struct.
        Messages are handled one after the other. When the last handler has returned, the job finishes with success;
        an exception (best `JobFailed("why")`) ends it without, and the promisee is refunded. Raises
        `ConfigurationError` for a second handler of a topic.
        """

        def register(handler: Callable[[Job, Any], Awaitable[object]]) -> Callable[[Job, Any], Awaitable[object]]:
            self._handlers.topics.add(topic, handler, kind)
            return handler

        return register

    def on_demand(self, handler: D) -> D:
        """Handle each new Demand of the agent's model, several at once: `async def handler(demand)`."""
        self._on_market(Demand, handler)
        return handler

    def on_offer(self, handler: O) -> O:
        """Handle each new Offer of the agent's model: `async def handler(offer)`."""
        self._on_market(Offer, handler)
        return handler

    def on_result(self, handler: R) -> R:
        """Handle each new Result on the market: `async def handler(result)`."""
        self._on_market(Result, handler)
        return handler

    def on_liability(self, handler: L) -> L:
        """Handle each phase of each of the agent's jobs: `async def handler(phase, liability)`."""
        self._handlers.liabilities.append(handler)
        return handler

    def on_reading(self, topic: str, *, agent: str = "*") -> Callable[[G], G]:
        """Handle what agents, or one (address), publish on `topic` outside of jobs: `async def handler(reading)`.

        A `Reading` has the `agent`, the `topic` and the `value`. They are handled one after the other.
        """
        reading_selector(agent, topic)  # raises InvalidKey

        def register(handler: G) -> G:
            self._handlers.readings.append((topic, agent, handler))
            return handler

        return register

    def every(self, seconds: float) -> Callable[[P], P]:
        """Call the handler, which takes no argument, at the start and then every `seconds` seconds."""

        def register(handler: P) -> P:
            self._handlers.periodic.append((seconds, handler))
            return handler

        return register

    def _on_market(self, kind: type[Demand | Offer | Result], handler: Handler) -> None:
        self._handlers.market.setdefault(kind, []).append(handler)


async def call(
    handler: Handler, *arguments: Any, logged: Callable[[AiraError], bool] = lambda _error: True
) -> AiraError | None:
    """Call a handler that belongs to no job. If it fails, that is logged (an `AiraError` if `logged` says so).

    The agent goes on. Returns the `AiraError`.
    """
    name = getattr(handler, "__name__", handler)
    try:
        await handler(*arguments)
    except AiraError as error:
        if logged(error):
            log.warning("handler %s: %s", name, error, extra=log_event("handler-failed", handler=name, code=error.code))
        return error
    except asyncio.CancelledError:
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            raise
        message = "handler %s was cancelled by what it waited for; the agent goes on"
        log.error(message, name, extra=log_event("handler-cancelled", handler=name))
    except Exception as error:
        facts = log_event("handler-crashed", handler=name, error=type(error).__name__)
        log.exception("handler %s failed; the agent goes on", name, extra=facts)
    return None


async def dispatch(
    subscription: Subscription[Any] | ReadingSubscription, handlers: Sequence[Handler], *, concurrency: int
) -> None:
    """Call all handlers with each message, one after the other; up to `concurrency` messages at once."""
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

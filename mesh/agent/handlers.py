"""The handlers of an agent: which it has, and how those that belong to no job are called."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

from mesh.errors import AiraError
from mesh.log_context import log_event
from mesh.work.registration import RegistrationError, call_handler, check_handler, name_of
from mesh.work.topic_handlers import InvalidTopic, TopicHandlers, check_topic
from schemas import Demand, Liability, Offer, Result, Verified, reading_selector
from schemas.address import is_ens_name
from schemas.cid import parse_cid
from schemas.errors import InvalidCid, InvalidKey

if TYPE_CHECKING:
    from mesh.network import Reading, ReadingSubscription, Subscription
    from mesh.work.job import Job
    from mesh.work.phases import Phase
    from schemas.verdicts import ValidatorReport

log = logging.getLogger(__name__)

Handler = Callable[..., object]
DemandHandler = Callable[[Verified[Demand]], object]
OfferHandler = Callable[[Verified[Offer]], object]
ResultHandler = Callable[[Verified[Result]], object]
LiabilityHandler = Callable[["Phase", Liability], object]
ReadingHandler = Callable[["Reading"], object]
ReportHandler = Callable[["ValidatorReport"], object]
PeriodicHandler = Callable[[], object]


class InvalidPeriod(RegistrationError, code="invalid-period"):
    """The interval of a periodic handler is not a positive number of seconds."""

    def __init__(self, seconds: object) -> None:
        super().__init__(f"{seconds!r} is not a number of seconds above 0", hint="write @agent.every(5.0)")
        self.seconds = seconds


class InvalidModel(RegistrationError, code="invalid-model"):
    """What an agent is given as its model is neither a CID, nor an ENS name, nor the path of a file."""

    def __init__(self, model: object) -> None:
        hint = 'the CID of a file is cid_of_file("model.md"), or what `aira cid model.md` prints'
        super().__init__(f"the model {str(model)[:80]!r} is neither a CID nor an ENS name", hint=hint)
        self.model = model


def check_model(model: object) -> None:
    """Raise `InvalidModel` for what can't be a model. Empty stands for any model."""
    try:
        if isinstance(model, Path):
            return
        if not isinstance(model, str) or (model and not is_ens_name(model) and not parse_cid(model)):
            raise InvalidModel(model)
    except InvalidCid:
        raise InvalidModel(model) from None


@dataclass
class Handlers:
    """The handlers of one agent."""

    topics: TopicHandlers = field(default_factory=TopicHandlers)
    """`topics.declared` has the type of each topic's messages."""
    market: dict[type[Demand | Offer | Result], list[Handler]] = field(default_factory=dict)
    liabilities: list[LiabilityHandler] = field(default_factory=list)
    reports: list[ReportHandler] = field(default_factory=list)
    readings: list[tuple[str, str, ReadingHandler]] = field(default_factory=list)
    """The topic, the agent (`*` for any), and the handler."""
    periodic: list[tuple[float, PeriodicHandler]] = field(default_factory=list)


D = TypeVar("D", bound=DemandHandler)
O = TypeVar("O", bound=OfferHandler)  # noqa: E741
R = TypeVar("R", bound=ResultHandler)
L = TypeVar("L", bound=LiabilityHandler)
G = TypeVar("G", bound=ReadingHandler)
J = TypeVar("J", bound=ReportHandler)
P = TypeVar("P", bound=PeriodicHandler)
K = TypeVar("K")
V = TypeVar("V")
T = TypeVar("T", bound=Callable[["Job", Any], object])


class HandlerDecorators:
    """The decorators of an `Agent`, which register handlers.

    A handler may be sync: it then runs in a thread of its own, and may block. What can't work raises a
    `RegistrationError`, a `ConfigurationError` with the line of your program.
    """

    def __init__(self) -> None:
        self._handlers = Handlers()

    @overload
    def on(self, topic: str) -> Callable[[T], T]: ...

    @overload
    def on(self, topic: str, kind: type[K]) -> Callable[[Callable[[Job, K], V]], Callable[[Job, K], V]]: ...

    def on(self, topic: str, kind: type | None = None) -> Callable[[Any], Any]:
        """Handle what objectives play on `topic` (`*`: on topics without a handler): `async def handler(job, message)`.

        The type of `message`, or `kind`, says what it is: a msgspec Struct, a dataclass, float, int, bool, str, bytes,
        `Empty`, `String`, list, dict, or a union of these. An objective with other messages is refused before it is
        played. Without a type, `message` is what was decoded: `Empty`, `String`, a number, JSON data, or bytes.

        Messages are handled one at a time. When the last handler has returned, the job finishes with success;
        an exception (best `JobFailed("why")`) ends it without, and the promisee is refunded.
        """
        check_topic(topic)

        def register(handler: Any) -> Any:
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
        check_handler(handler, "phase: Phase, liability: Liability", arguments=2)
        self._handlers.liabilities.append(handler)
        return handler

    def on_report(self, handler: J) -> J:
        """Handle each juror's report on a contract of the agent's account: `async def handler(report)`.

        The report is signed, by a juror of the contract's validator; `success` is the verdict, `failures` the reasons.
        """
        check_handler(handler, "report: ValidatorReport", arguments=1)
        self._handlers.reports.append(handler)
        return handler

    def on_reading(self, topic: str, *, agent: str = "*") -> Callable[[G], G]:
        """Handle what agents, or one (address), publish on `topic` outside of jobs: `async def handler(reading)`.

        A `Reading` has the `agent`, the `topic` and the `value`. They are handled one at a time.
        """
        try:
            reading_selector(agent, topic)
        except InvalidKey as error:
            if error.text == agent:
                raise RegistrationError(error.why, hint='write the address of an agent: agent="0x…"') from None
            raise InvalidTopic(error.text, error.why) from None

        def register(handler: G) -> G:
            check_handler(handler, "reading: Reading", arguments=1)
            self._handlers.readings.append((topic, agent, handler))
            return handler

        return register

    def every(self, seconds: float) -> Callable[[P], P]:
        """Call the handler, which takes no argument, at the start and then every `seconds` seconds."""
        _check_period(seconds)

        def register(handler: P) -> P:
            check_handler(handler, "", arguments=0)
            self._handlers.periodic.append((seconds, handler))
            return handler

        return register

    def _on_market(self, kind: type[Demand | Offer | Result], handler: Handler) -> None:
        name = kind.__name__
        check_handler(handler, f"{name.lower()}: Verified[{name}]", arguments=1)
        self._handlers.market.setdefault(kind, []).append(handler)


def _check_period(seconds: object) -> None:
    if not isinstance(seconds, int | float) or not 0 < seconds < math.inf:
        raise InvalidPeriod(seconds)


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

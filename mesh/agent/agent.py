"""The agent, which users write: a model, handlers, and `run`; what it does on its market, and what it says there."""

from __future__ import annotations

import asyncio
import logging
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, TypedDict, TypeVar, Unpack, overload

from mesh.agent._answers import Answer, Question, Unanswered, metadata_of_answer
from mesh.agent._attempts import Attempts, check_attempts
from mesh.agent.components import working
from mesh.agent.contracts import nothing
from mesh.agent.demands import DEMAND_LIMITS
from mesh.agent.handlers import (
    ANY_TOPIC,
    DemandHandler,
    Handler,
    Handlers,
    LiabilityHandler,
    ObjectiveMessages,
    OfferHandler,
    PeriodicHandler,
    QuoteHandler,
    ReadingHandler,
    RegistrationError,
    ReportHandler,
    ResultHandler,
    StopHandler,
    check_handler,
    check_model,
    check_parallel,
    check_period,
    check_topic,
    dispatch,
    invalid_topic,
    repeat,
)
from mesh.agent.hiring import DemandDeclined
from mesh.agent.jobs import check_stop
from mesh.agent.ledger import WrongPhase
from mesh.agent.objectives import ObjectiveUnfit
from mesh.agent.orders import HANDLED_FOR, OrderClosed, OrderState
from mesh.agent.statement import period, read_statement
from mesh.agent.validators import ValidatorSilent, check_named
from mesh.amounts import XRT
from mesh.base.log_context import log_event
from mesh.errors import ChainError, ClosedError, ConfigurationError, InputError, RemoteError
from mesh.network import ReadingSubscription, ServiceFailed, sending
from mesh.network.readings import LARGEST_READING
from mesh.recording import encode_described, pack_values
from mesh.role.composition import watching
from mesh.role.models import Models, description_in
from mesh.role.program import RESEND, OpenRole, Program, WatcherStatus
from mesh.settings import load
from mesh.watching.robots import QUOTE_TIMEOUT, RobotDirectory, asked_quotes, labelled, robot_address
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Offer,
    Result,
    SignedMessage,
    Verified,
    cid_of_file,
    parse_address,
    reading_selector,
    verify_message,
)
from schemas.cid import is_cid
from schemas.errors import InvalidKey
from schemas.keys import ReadingKey
from schemas.model import ModelDescription, topic_gap, topic_of
from schemas.records import ControlRobot
from schemas.rpc import Stopped

if TYPE_CHECKING:
    from collections.abc import Collection, Coroutine, Iterator, Mapping
    from contextlib import AsyncExitStack

    from mesh.agent._runtime import AgentRuntime, AgentStatus
    from mesh.agent.components import AgentComponents
    from mesh.agent.contracts import Contract, OnProgress
    from mesh.agent.handlers import Job, TopicHandlers
    from mesh.agent.orders import Terms
    from mesh.agent.statement import Statement
    from mesh.agent.trade import OnSigned, Order
    from mesh.agent.validators import AnnouncedValidator
    from mesh.base.retry import RetryPolicy
    from mesh.chain import Account, Chain
    from mesh.content import Store
    from mesh.network import Channel, Network, Subscription
    from mesh.recording import Objective
    from mesh.settings import Settings
    from mesh.watching import Robot
    from schemas.model import ModelLimits
    from schemas.payloads import PayloadType
    from schemas.records import RobotControl
    from schemas.rpc import Quote, QuoteRequest
    from schemas.signing import Decline


class ModelUnfit(ConfigurationError, code="model-unfit"):
    """The handlers of an agent don't fit the description of its model: it would take orders that it can't do."""

    def __init__(self, model: str, why: str) -> None:
        hint = "change the handlers or the description; `aira model new PROGRAM.py` writes one from the handlers"
        super().__init__(f"the handlers don't fit the model {model}: {why}", hint=hint)
        self.model = model
        self.why = why


def model_of(model: str | Path) -> str:
    """The model that an agent is given: its name, or the CID of its file. Raises `ConfigurationError`."""
    with _reading(model):
        return model if isinstance(model, str) else cid_of_file(model)


@contextmanager
def _reading(model: str | Path) -> Iterator[None]:
    """Raise a `ConfigurationError` if the file of a model can't be read."""
    try:
        yield
    except OSError as error:
        why, hint = error.strerror or str(error), "`aira model new PROGRAM.py` writes one"
        raise ConfigurationError(f"can't read the model {model}: {why}", hint=hint, code="model-unreadable") from None


def derived(topics: TopicHandlers, result: Mapping[str, Any], fields: dict[str, Any]) -> ModelDescription:
    """The description of what these handlers take; `result` has the Python type of each topic that they publish.

    `fields` are others of `ModelDescription`. Raises `InvalidDescription`.
    """
    taken = topics.declared
    description = ModelDescription(
        objective=tuple(topic_of(topic, kind) for topic, kind in taken.items() if topic != ANY_TOPIC),
        other_topics=ANY_TOPIC in taken,
        result=tuple(topic_of(topic, kind) for topic, kind in result.items()),
        **fields,
    )
    description.encode()  # a constructor does not check lengths and ranges
    return description


def require_fit(description: ModelDescription, topics: TopicHandlers) -> None:
    """Raise `ModelUnfit` unless the handlers take every message that the description allows, and no other topics.

    An agent without handlers leaves the work to devices, of which nothing is known here.
    """
    taken = topics.declared
    if not taken:
        return
    for topic in description.objective:
        kind = taken.get(topic.topic, taken.get(ANY_TOPIC))
        if kind is None:
            raise ModelUnfit(description.cid, f"no handler takes {topic.topic}")
        if why := topic_gap(topic, topic_of(topic.topic, kind)):
            raise ModelUnfit(description.cid, why)
    if description.other_topics and ANY_TOPIC not in taken:
        raise ModelUnfit(description.cid, "no handler takes other topics")
    if not description.other_topics:
        unknown = sorted(topic for topic in taken if topic != ANY_TOPIC and description.topic(topic) is None)
        if unknown:
            raise ModelUnfit(description.cid, f"the model has no topic {unknown[0]}, which a handler takes")


async def own_description(
    parts: AgentComponents, models: Models, model: str | Path, topics: TopicHandlers
) -> ModelDescription | None:
    """The description of an agent's own model, which its handlers fit; None if it has none, or nobody serves it now.

    A file is put into the store, from which others fetch it. Raises `InvalidDescription`, `ConfigurationError`.
    """
    if isinstance(model, str):
        description = None
        with suppress(ChainError):  # a name that can't be resolved now
            cid = await parts.chain.names.model(model) if model else ""
            description = await models.find(cid) if cid else None
    else:
        with _reading(model):
            description = await asyncio.to_thread(description_in, model)
            await asyncio.to_thread(parts.store.put_file, model, pin="model")
    if description is not None:
        require_fit(description, topics)
    return description


D = TypeVar("D", bound=DemandHandler)
O = TypeVar("O", bound=OfferHandler)  # noqa: E741
R = TypeVar("R", bound=ResultHandler)
L = TypeVar("L", bound=LiabilityHandler)
G = TypeVar("G", bound=ReadingHandler)
J = TypeVar("J", bound=ReportHandler)
Q = TypeVar("Q", bound=QuoteHandler)
P = TypeVar("P", bound=PeriodicHandler)
S = TypeVar("S", bound=StopHandler)
K = TypeVar("K")
V = TypeVar("V")
T = TypeVar("T", bound=Callable[["Job", Any], object])


Messages: TypeAlias = Sequence[tuple[str, object]]
"""Topics with what is published on them: anything that `Job.publish` accepts."""


class DemandTerms(TypedDict, total=False):
    cost: int | str
    model: str
    token: str
    validator: str
    validator_fee: int | str | None
    permit_fee: int | str
    lifetime: int | None
    robot: str
    max_cost: int | str | None
    retry: int
    start_within: float | None


CHEAPEST: Final = "cheapest"
CHOICES: Final = (CHEAPEST, "first")
"""The words for a robot that is chosen by its quote."""
MOST_EXAMINED: Final = 10_000
"""Messages that `Agent.examine` gives of a demand."""


class Changes(TypedDict, total=False):
    price: str
    paused: bool
    refuse: tuple[str, ...]
    least_price: str
    stop: str
    release: bool


class DescriptionFields(TypedDict, total=False):
    """The optional arguments of `Agent.model_description`: the fields of `ModelDescription` that handlers don't say."""

    description: str
    success: str
    price: str
    seconds: float
    on_stop: Literal["refund", "paid"]
    limits: ModelLimits


class Agent(Program):
    """A participant of the market: `agent = Agent(model)`, handlers, then `agent.run()` or `async with agent`.

    `model` is the CID of the behaviour that it offers or demands ('' for any), or the path of the model's file, which
    it then serves. If the model has a description, the handlers must fit it, and objectives are checked against it.
    With an account (`account`, or a keyfile in the settings) it trades and works; without one it only watches the
    market. It opens nothing before `run` or `async with`. Any number of agents can run in one event loop. `chain`, if
    given, is an open chain to use instead of the one that the settings name; `resend` is how often messages without
    effect are sent again. Jobs run one after the other, or `parallel` at a time if the handlers can do several at once.

    The decorators register handlers. A handler may be sync: it then runs in a thread of its own, and may block. What
    can't work raises a `RegistrationError`, a `ConfigurationError` with the line of your program.
    """

    title = "agent"
    needs_account = False

    def __init__(
        self,
        model: str | Path = "",
        *,
        settings: Settings | None = None,
        account: Account | None = None,
        chain: Chain | None = None,
        parallel: int = 1,
        resend: RetryPolicy = RESEND,
    ) -> None:
        check_model(model)
        check_parallel(parallel)
        super().__init__(load() if settings is None else settings, account=account, chain=chain)
        self.model = ""
        with suppress(ConfigurationError):  # without its file, which is required when it is opened
            self.model = model_of(model)
        self._given_model = model
        self._parallel = parallel
        self._resend = resend
        self._handlers = Handlers()
        self._link: tuple[Network, Channel] | None = None
        """While it is open: its session, and the channel of its market."""
        self._runtime: AgentRuntime | None = None

    def __repr__(self) -> str:
        who = f", account={self.address}" if self._runtime is not None else ""
        return f"Agent(model={self.model or '(any)'}{who})"

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

    def on_quote(self, handler: Q) -> Q:
        """Answer what a job would cost: `async def handler(request) -> "5 XRT"`, or raise `Declined("code", "why")`.

        `request.objective` is the CID, which `agent.examine` reads. Without a handler the price is that of the model's
        description. A robot that has no handler of demands is not asked.
        """
        check_handler(handler, "request: QuoteRequest", arguments=1)
        self._handlers.quotes = [handler]
        return handler

    def on_stop(self, handler: S) -> S:
        """Bring the robot to a safe state when a job was stopped: `async def handler(job, why)`.

        The devices that hear a stop have heard it, and the job's handlers are cancelled; a sync one goes on in its
        thread, but can't publish any more. What this handler publishes on the job becomes the end of its recording. It
        has `JOB_STOP_PACE.safe` seconds. The next job waits for it. It is not called for a job that had not begun.
        """
        check_handler(handler, "job: Job, why: str", arguments=2)
        self._handlers.stops.append(handler)
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
            raise invalid_topic(error.text, error.why) from None

        def register(handler: G) -> G:
            check_handler(handler, "reading: Reading", arguments=1)
            self._handlers.readings.append((topic, agent, handler))
            return handler

        return register

    def every(self, seconds: float) -> Callable[[P], P]:
        """Call the handler, which takes no argument, at the start and then every `seconds` seconds."""
        check_period(seconds)

        def register(handler: P) -> P:
            check_handler(handler, "", arguments=0)
            self._handlers.periodic.append((seconds, handler))
            return handler

        return register

    def _on_market(self, kind: type[Demand | Offer | Result], handler: Handler) -> None:
        name = kind.__name__
        check_handler(handler, f"{name.lower()}: Verified[{name}]", arguments=1)
        self._handlers.market.setdefault(kind, []).append(handler)

    def model_description(
        self, title: str, *, result: Mapping[str, Any] | None = None, **fields: Unpack[DescriptionFields]
    ) -> ModelDescription:
        """A description of what the agent's handlers take, by the types of their messages.

        `result` has the type of what they publish, by topic. Limits, titles and units are those of `msgspec.Meta`:
        `Annotated[float, Meta(ge=0, le=2, title="Speed", extra_json_schema={"unit": "m/s"})]`. Its `cid` is the model.
        Raises `InvalidDescription`.
        """
        return derived(self._handlers.topics, result or {}, {"title": title, **fields})

    @property
    def runtime(self) -> AgentRuntime:
        """The working side of a running agent. Raises `ClosedError` if it is not running or has no account."""
        if self._runtime is None:
            self._opened()
            raise ConfigurationError(
                "this agent has no account, it only watches",
                hint="give it one: keyfile and keyfile_password_file in the settings",
            )
        return self._runtime

    @property
    def parts(self) -> AgentComponents:
        """The components of a running agent. Raises as `runtime` does."""
        return self.runtime.parts

    @property
    def chain(self) -> Chain:
        """The open chain; `chain.web3` talks to any other contract. Raises as `runtime` does."""
        return self.parts.chain

    @property
    def network(self) -> Network:
        """The Zenoh session and its state. Raises `ClosedError` if the agent is not running."""
        return self._opened()[0]

    @property
    def channel(self) -> Channel:
        """The lighthouse's channel. Raises `ClosedError` if the agent is not running."""
        return self._opened()[1]

    @property
    def address(self) -> str:
        """The account's address (EIP-55)."""
        return self.parts.signer.address

    async def offer(
        self,
        demand: Verified[Demand] | Demand | None = None,
        *,
        objective: str = "",
        cost: int | str = 0,
        token: str = "",
        validator: str = "",
        lighthouse_fee: int | str = 0,
        lifetime: int | None = None,
    ) -> str:
        """Offer to do a job; returns the order's hash (hex). The offer is resent until it is matched or expires.

        With a `demand` the offer agrees to its terms, once its objective was examined; an open offer with the same fee
        for it, or in generation 5 for another version of it, is enough. Else `objective` (CID), `cost` (`"5 XRT"`,
        `"3.50 USDC"`, `"3.50 0x…"`, or a number of the token's smallest unit), `token` (address, name or known symbol;
        by default what `cost` names, else the setting `erc20_token`) and `validator` are the terms, valid for
        `lifetime` blocks, by default about ten minutes. `lighthouse_fee` (`"0.1 XRT"`, or wn) is paid to the provider.

        An offer is for its terms: it matches every demand with equal ones. It is withdrawn when its demand has become a
        contract with another offer or was withdrawn, when a handler declines a demand with equal terms, and when the
        agent ends.

        Raises `InsufficientTokens`, `InvalidAmount`, for an objective that can't be played `ObjectiveUnfit` or a
        `ContentError`, an `AiraError` for a demand that is a contract, and `Declined` for one whose validator wants a
        higher fee or is not one of the setting `accepted_validators`, while an equal one is open that was declined, or
        while the robot was stopped or paused.
        """
        trader, fee = self.runtime.trader, XRT.amount(lighthouse_fee)
        if (stopped := self.runtime.rules.stopped()) is not None:
            raise stopped
        if demand is None:
            terms = await trader.writer.terms(
                model=self.model, objective=objective, cost=cost, token=token, validator=validator, lifetime=lifetime
            )
            return (await trader.post(Offer, terms, lighthouse_fee=fee)).hash
        verified = demand if isinstance(demand, Verified) else verify_message(demand)
        wanted, answered = verified.message, trader.answered.note(verified)
        await self.runtime.validators.require_accepted(wanted, self.settings.accepted_validators)
        await self.examine(wanted.objective)
        await trader.require_open(answered)
        offered = answered.offer
        if offered is not None and offered.is_open and getattr(offered.signed, "lighthouse_fee", None) == fee:
            return offered.identity
        return (await trader.post(Offer, trader.writer.terms_of(wanted), answers=answered, lighthouse_fee=fee)).hash

    @overload
    async def examine(self, wanted: str) -> Objective: ...

    @overload
    async def examine(self, wanted: Verified[Demand] | Demand | QuoteRequest) -> ObjectiveMessages: ...

    async def examine(self, wanted: str | Verified[Demand] | Demand | QuoteRequest) -> Objective | ObjectiveMessages:
        """The objective with that CID, fetched if needed, after it was checked as before a job.

        Of a demand, or of a request for a quote, its messages, each as the type that its handler takes:
        `sum(move.meters for move in (await agent.examine(demand)).of(Move))`. They are `MOST_EXAMINED` at most.

        Raises `ObjectiveUnfit`, whose `reason` is a word for programs, and branches of `ContentError`; while a demand
        is handled also `ObjectiveNotFetched`, as what strangers make an agent fetch is limited.
        """
        # seconds without a new block
        examine = partial(self.runtime.objectives.examine, patience=10.0, buyer=HANDLED_FOR.get())
        if isinstance(wanted, str):
            return await examine(wanted)
        cid = (wanted.message if isinstance(wanted, Verified) else wanted).objective
        objective = await examine(cid)
        if objective.count > MOST_EXAMINED:
            raise ObjectiveUnfit(cid, "too-many-messages", f"it has more than {MOST_EXAMINED:,}, which have no price")
        return await asyncio.to_thread(lambda: self._handlers.topics.typed(objective.messages()))

    async def order(
        self,
        objective: str | Path | Messages,
        *,
        cost: int | str = 0,
        model: str = "",
        token: str = "",
        validator: str = "",
        validator_fee: int | str | None = None,
        permit_fee: int | str = 0,
        lifetime: int | None = None,
        robot: str = "",
        max_cost: int | str | None = None,
        retry: int = 0,
        start_within: float | None = None,
        on_signed: OnSigned | None = None,
    ) -> Order:
        """Demand a job; returns the open order, to be waited for or withdrawn: `await order.contract()`.

        `objective` is a CID, the path of a file (also as text), or messages that are played one after the other, such
        as `[("/blink", "red"), ("/stop", Empty())]`; the agent serves it. The other terms are as for `offer`;
        `validator_fee` is `"0.1 XRT"`, or wn; by default what the validator announces. The factory gets the allowance
        that they need. A restarted agent sends the order again.

        `permit_fee` is what the provider gets for creating the contract with a permit of this agent, which needs no
        ether for that: an amount in the token of the `cost`. It is charged once, when the contract is created, and only
        with the permit. A provider that wants more rejects the demand as `unpaid`, and says how much. A demand has one
        fee, so it can't have a validator, too.

        With a `robot` (its name or address) only that one gets the job: it is asked for its offer, and the demand is
        not published. Raises `DemandDeclined` with its reason if it makes none, `ServiceFailed` if it does not answer,
        and as `robot_address` for a name.

        `robot="cheapest"` and `"first"` (the one that would be done first) ask all for `quotes`, and order from one at
        its price, if that is `max_cost` (else `cost`) at most; if it declines, from the next one. Only quotes in the
        token of `max_cost` (else `cost`) count: prices in different tokens can't be compared. With a `max_cost`,
        `cost` is raised up to that if robots want more. Raises `RemoteError` (`no-robot-fits`).

        A job that fails is ordered again up to `retry` times (10 at most), once its cost has come back: from the
        `cheapest` of the other robots, or the `first`, for the same price at most, until the first order's deadline. A
        robot that does not begin within `start_within` seconds after the contract is told to stop, and has failed. The
        contract of the order stands for all attempts. It ends with this agent: a restarted one orders nothing again.

        `on_signed` is awaited with the signed demand before that is posted, unless the robot is chosen by its quote:
        a program that was killed knows by it whether its order was posted.

        Raises `InputError`, `InsufficientTokens`, `ObjectiveUnfit` if a file is not playable, or
        if the model's description is available and excludes the objective, `UnsafeValidator` and its like for a
        validator that can't be named, and `ValidatorSilent` if its fee is not known because nobody answers.
        """
        check_attempts(retry, start_within, robot="" if robot in CHOICES else robot)
        cid = await self._cid_of(objective)
        others: dict[str, Any] = {"token": token, "validator": validator, "validator_fee": validator_fee}
        others["permit_fee"] = permit_fee
        chosen: dict[str, Any] = {"cost": cost, "model": model, "max_cost": max_cost, "start_within": start_within}
        attempts = None
        if retry or start_within is not None:
            again = partial(self._order_by_quote, cid, **chosen, robot=robot or CHEAPEST, **others)
            attempts = Attempts(self.parts, again, retry=retry, start_within=start_within)
        if robot in CHOICES or max_cost is not None:
            others |= {"lifetime": lifetime, "attempts": attempts}
            return await self._order_by_quote(cid, **chosen, robot=robot, **others)
        return await self._order(
            cid,
            cost=cost,
            model=model,
            lifetime=lifetime,
            robot=robot,
            attempts=attempts,
            on_signed=on_signed,
            **others,
        )

    async def _order(
        self,
        cid: str,
        *,
        cost: int | str,
        model: str,
        token: str,
        validator: str,
        validator_fee: int | str | None,
        permit_fee: int | str,
        lifetime: int | None,
        robot: str,
        attempts: Attempts | None,
        on_signed: OnSigned | None = None,
    ) -> Order:
        """Demand a job at a price, of any robot or of one that was named."""
        writer = self.runtime.trader.writer
        terms = await writer.terms(
            model=model or self.model, objective=cid, cost=cost, token=token, validator=validator, lifetime=lifetime
        )
        await self.runtime.require_fit(cid, terms["model"])
        fee = await self._fee_of(terms, validator_fee, permit_fee)
        named = ""
        if robot:
            named = await robot_address(self.network.session, self.channel, robot, model=terms["model"])
        return await self.runtime.trader.post(
            Demand, terms, robot=named, attempts=attempts, on_signed=on_signed, validator_fee=fee
        )

    async def demand(
        self,
        objective: str | Path | Messages,
        *,
        on_progress: OnProgress = nothing,
        wait: bool = False,
        **terms: Unpack[DemandTerms],
    ) -> Contract:
        """Demand a job and wait for the contract: `contract = await agent.demand(…); await contract.outcome()`.

        The terms are those of `order`, `on_progress` that of `Order.contract`. If all robots of the model that are
        present decline, the demand is withdrawn, and `DemandDeclined` says why; with `wait` it stays open. Cancelling
        calls the demand off. Raises `OrderExpired`, `OrderClosed` (withdrawn elsewhere), `InsufficientTokens`, and
        `OtherRobot` if another one than the `robot` that was named has the contract.
        """
        order = await self.order(objective, **terms)
        try:
            return await order.contract(on_progress=on_progress, wait=wait)
        except asyncio.CancelledError:
            if self._runtime is not None:
                with suppress(OrderClosed):  # it has just become a contract
                    await order.call_off()
            raise

    @overload
    async def validator(self, whose: str) -> AnnouncedValidator: ...

    @overload
    async def validator(self, whose: Verified[Demand] | Demand) -> AnnouncedValidator | None: ...

    async def validator(self, whose: str | Verified[Demand] | Demand) -> AnnouncedValidator | None:
        """How a validator (address or name), or that of a demand, judges, as its jurors announce it now.

        `AnnouncedValidator.is_silent` if none answers. None for a demand without a validator. The answers are kept for
        a minute. Raises `ChainError`, and for a name that can't be resolved what `demand` raises.
        """
        if not isinstance(whose, str):
            named = (whose.message if isinstance(whose, Verified) else whose).validator
            return None if named == ZERO_ADDRESS else await self.runtime.validators.find(named)
        return await self.runtime.validators.find(await self.parts.chain.names.address(whose))

    async def robots(self, model: str = "") -> list[Robot]:
        """The robots that are present now, or those of a `model` (CID or name), by name; each as it presents itself.

        An agent with an account also counts what the chain's latest contracts paid them (`Robot.paid`, `refunded`).
        Anybody may choose any name: `Robot.address` says who it is. Raises what a model's name raises, `ClosedError`.
        """
        network, channel = self._opened()
        if self._runtime is None:
            return await RobotDirectory(network.session, channel).present(model)
        chain, directory = self.parts.chain, self.parts.robots
        robots = await directory.present(await chain.names.model(model) if model else "")
        try:
            return await directory.count(chain, robots)
        except ChainError as error:  # then the records are not known
            log.debug("the records of robots can't be counted now: %s", error)
            return robots

    async def quotes(
        self, model: str, objective: str | Path | Messages, *, timeout: float = QUOTE_TIMEOUT
    ) -> list[Quote]:
        """What the robots of a model (CID or name) that are present want for an objective, as in `order`.

        The cheapest is first, of each token that robots want to be paid in; those in the token of the settings come
        before the others. Those with a `code` don't want the job. Not listed is who does not answer within
        `timeout` seconds, and robots of the legacy network. A quote binds nobody. Raises `ObjectiveUnfit` as `order`.
        """
        cid, named = await self._cid_of(objective), await self.parts.chain.names.model(model or self.model)
        await self.runtime.require_fit(cid, named)
        robots = await self.parts.robots.present(named, timeout=timeout)
        return await asked_quotes(
            self.network.session,
            self.channel,
            asker=self.parts.signer,
            robots=[one.address for one in robots],
            model=named,
            objective=cid,
            token=await self.parts.chain.tokens.address(self.settings.erc20_token),
            timeout=timeout,
        )

    async def _order_by_quote(
        self,
        objective: str,
        *,
        cost: int | str,
        max_cost: int | str | None,
        start_within: float | None,
        robot: str,
        model: str,
        besides: Collection[str] = (),
        attempts: Attempts | None = None,
        **terms: Any,
    ) -> Order:
        """Order at the price that robots want, up to `max_cost`: from any of them, or from the one that is chosen.

        None of `besides` (addresses) is asked.
        """
        tokens = self.parts.chain.tokens
        given = (cost,) if max_cost is None else (cost, max_cost)
        token, unit, amounts = await tokens.amounts(*given, token=terms["token"], default=self.settings.erc20_token)
        least, most = amounts[0], amounts[-1]
        terms["token"] = token
        if robot in CHOICES:
            least = 0
        elif robot:
            robot = await robot_address(self.network.session, self.channel, robot)
        quotes = [quote for quote in await self.quotes(model, objective) if quote.agent not in besides]
        found = [quote for quote in quotes if robot in ("", *CHOICES, quote.agent)]
        fitting = [quote for quote in found if not quote.code and quote.token == token and quote.cost <= most]
        if start_within is not None:
            fitting = [quote for quote in fitting if quote.start <= start_within]
        if robot == "first":
            fitting.sort(key=lambda quote: (quote.start + quote.seconds, quote.cost))
        if not robot:
            paid = max(least, min((int(quote.cost) for quote in fitting), default=least))
            return await self._order(objective, cost=paid, model=model, robot="", attempts=attempts, **terms)
        declined: list[Decline] = []
        for quote in fitting:
            try:
                paid = max(least, int(quote.cost))
                return await self._order(
                    objective, cost=paid, model=model, robot=quote.agent, attempts=attempts, **terms
                )
            except DemandDeclined as error:
                declined += error.declines
            except ServiceFailed as error:
                log.info(
                    "%s does not answer: %s", quote.agent, error, extra=log_event("robot-silent", robot=quote.agent)
                )
        units = await tokens.units(one.token for one in found if one.token)
        refusals = [(one.agent, f"declines ({one.code})") for one in declined]
        for one in (one for one in found if one not in fitting):
            is_late = start_within is not None and one.start > start_within and not one.code
            why = f"begins in {one.start:g} s" if is_late else f"declines ({one.code})"
            refusals.append((one.agent, why if is_late or one.code else f"wants {units[one.token].show(one.cost)}"))
        said = [f"{labelled(agent, self.parts.robots.name(agent))} {why}" for agent, why in refusals]
        raise RemoteError(
            f"no robot does it for {unit.show(most)}: {'; '.join(said[:5]) or 'none of this model answers'}",
            hint="give a higher max_cost, or see `aira quotes`",
            code="no-robot-fits",
        )

    def orders(self, *states: OrderState) -> list[Order]:
        """The account's orders in these states, oldest first; by default the open ones, those of earlier runs included.

        Withdrawn ones are listed until their deadline. Matched and expired ones are not listed.
        """
        return self.runtime.trader.orders(*(states or (OrderState.OPEN,)))

    async def contract(self, address: str) -> Contract:
        """The contract at `address`, of any account; `outcome` waits for its end. Raises `NotALiability`."""
        return await self.runtime.trader.contracts.read(address)

    async def statement(self, first: str = "", last: str = "") -> Statement:
        """What the account has earned and spent, from a day or month to another one: `"2026-11-30"`, `"2026-11"`.

        Both are included, and in UTC; empty ones are open. Raises `InputError` and the errors of the chain.
        """
        since, until = period(first, last)
        return await read_statement(self.chain, self.address, since=since, until=until)

    async def control(self, **changes: Unpack[Changes]) -> RobotControl:
        """Change what the owner may change while the robot runs; returns what is in effect: also without a change.

        `price` (`"6 XRT"`) is what the profile and quotes say; empty for that of the model's description. While the
        robot is `paused` it takes no new jobs. `refuse` are the customers (addresses) that it never works for,
        `least_price` is the least cost of a job; empty for any. These stay as they are when the agent is restarted, and
        override its settings. `stop="why"` stops all jobs, and lets none begin until `release=True`.

        Raises `InvalidAmount`, `InvalidAddress`, `InputError` for a reason that is too long, and an `AiraError` with
        the code `held-on-machine` if `aira stop` on its machine holds the robot.
        """
        return await self.runtime.control(ControlRobot(**changes))

    async def hand_back(self, address: str, code: str, why: str = "") -> Stopped:
        """Give back the job of the liability at `address`, because the robot can't do it: its customer is refunded.

        At once, in any phase before its end. A job that has begun is stopped as by `Contract.stop`, except that
        `hold_when_stopped` does not apply: what the robot's devices say is returned. `code` is a word for programs
        (`tool-broken`), `why` a line of at most 200 characters for people; both become public with the recording. To
        hand a job back again changes nothing, nor does it after a stop. A handler of the job itself is cancelled by
        this; it rather raises `JobFailed("why", code="tool-broken")`.

        Raises `InputError` for another code or a `why` that is too long, and `WrongPhase` for a job that has ended, or
        is not this agent's.
        """
        address = parse_address(address)
        check_stop(why, code)
        if not self.settings.enable_executor:
            raise WrongPhase(address, asked="hand back", phase=None)
        return Stopped(await self.runtime.executor.hand_back(address, code=code, why=why))

    async def finish(self, address: str, *, success: bool) -> str:
        """End the job of the liability at `address` now; returns the recording's CID. Raises `WrongPhase`."""
        return await self.runtime.executor.finish(address, success=success)

    def send(self, message: SignedMessage) -> str:
        """Sign a message with the agent's account and put it on the market once; returns its key. It is not resent.

        Raises `UnsafeValidator` for an order with a validator that was not checked on the chain before, as `demand` and
        `offer` do.
        """
        if isinstance(message, Demand | Offer):
            self.parts.chain.validators.check_known(message)
        return self.channel.publish(self.parts.signer.sign(message))

    async def add(self, path: str | Path) -> str:
        """Copy a file to the agent's store, which serves it to others; returns its CID."""
        return await asyncio.to_thread(self.parts.store.put_file, Path(path))

    async def _fee_of(self, terms: Terms, validator_fee: int | str | None, permit_fee: int | str) -> int:
        """The fee of a demand with these terms: the validator's in wn, or without one that for a permit."""
        if terms["validator"] != ZERO_ADDRESS:
            if permit_fee:
                raise InputError(
                    "a demand with a validator has no permit_fee",
                    hint="omit one of them: a demand has one fee, which is the validator's if it has one",
                    code="fee-misplaced",
                )
            return await self._announced_fee(terms) if validator_fee is None else XRT.amount(validator_fee)
        if validator_fee is not None and XRT.amount(validator_fee):
            raise InputError(
                "a demand without a validator has no validator_fee",
                hint="name a validator, or give a permit_fee, which the provider gets",
                code="fee-misplaced",
            )
        if not permit_fee:
            return 0
        paid = await self.parts.chain.tokens.amounts(permit_fee, token=terms["token"])
        if paid.values[0] and not await self.parts.chain.permits.are_taken(paid.token):
            raise InputError(
                f"the token {paid.unit.symbol} has no permits, so nobody would be paid a permit_fee",
                hint="omit the permit_fee: the factory is approved by a transaction",
                code="token-without-permits",
            )
        return paid.values[0]

    async def _announced_fee(self, terms: Terms) -> int:
        """What the validator of these terms wants, in wn. Raises `ValidatorSilent`."""
        validator = terms["validator"]
        generation = self.settings.generation
        await check_named(self.parts.chain, validator, lighthouse=terms["lighthouse"], generation=generation)
        announced = await self.runtime.validators.find(validator)
        if announced.is_silent:
            raise ValidatorSilent(validator)
        return announced.fee

    async def _cid_of(self, objective: str | Path | Messages) -> str:
        """The CID of an objective, once the agent's store has it. Raises `InputError`."""
        if not isinstance(objective, str | Path):
            return await asyncio.to_thread(put_values, self.parts.store, objective)
        if isinstance(objective, str) and is_cid(objective):
            return objective
        if not await asyncio.to_thread(Path(objective).is_file):
            raise InputError(
                f"{str(objective)!r} is neither a CID nor a file",
                hint="name an MCAP file or a ROS 1 bag that exists, or a CID of 46 characters (Qm…)",
                code="not-an-objective",
            )
        await self.runtime.objectives.require_playable(Path(objective))
        return await self.add(objective)

    async def fetch(self, cid: str) -> Path:
        """The file with that CID, from the store or fetched from others and checked. Raises a `ContentError`."""
        limit, timeout = self.settings.objective_expanded_limit, self.settings.fetch_timeout
        return await self.parts.exchange.fetch(cid, size_limit=limit, timeout=timeout)

    def publish(self, topic: str, message: object) -> None:
        """Publish a reading on a topic of the agent, outside any job. Those who listen now get it.

        `message` is anything that `Job.publish` accepts. The latest ones of four topics are in the robot's profile.
        Raises `InputError` for an invalid topic or message, or one that is too large, `ClosedError`, and
        `ConfigurationError` if the agent has no account.
        """
        session, key = self.parts.network.session, str(ReadingKey(self.address, topic))
        payload, kind = _encoded(topic, message)
        sending.put(session, key, payload, encoding=kind.zenoh_encoding)
        self.runtime.profile.read(topic, payload, kind)

    def readings(self, topic: str = "/**", *, agent: str = "*") -> ReadingSubscription:
        """What agents publish outside of jobs: `async with agent.readings("/battery") as readings`, then iterate.

        By default on all topics, by all agents; `agent` is an address. Raises `InvalidKey`, `ClosedError`.
        """
        return ReadingSubscription(self.network.session, agent=agent, topic=topic, drops=self.drops)

    async def answer(self, demand: Verified[Demand], value: object, *, topic: str = "/answer") -> str:
        """Answer a demand without a contract; returns the CID of the recording with the `value`.

        `value` is anything that `Job.publish` accepts. A Result that names the asker as its liability is put on the
        market once; who asks with `ask` asks again if it is lost. Raises as `publish` does.
        """
        _encoded(topic, value)
        options = {"time_ns": time.time_ns(), "metadata": metadata_of_answer(demand, self.address)}
        cid = await asyncio.to_thread(put_values, self.parts.store, [(topic, value)], **options)
        self.send(Result(liability=demand.signer, result=cid, success=True))
        facts = log_event("demand-answered", demand=demand.hash.hex(), signer=demand.signer, result=cid)
        log.info("answered %s without a contract: %s", demand.signer, cid, extra=facts)
        return cid

    async def ask(
        self, model: str = "", objective: str | Path | Messages = "", *, agent: str = "", timeout: float = 60.0
    ) -> Answer:
        """Ask the agents of a model, by default this agent's, and return the first answer: `(await agent.ask()).value`.

        The question is a demand that pays nothing, asked again until an answer comes, and then withdrawn. Its
        `objective`, as that of `order`, says what is asked, if the model needs that. With an `agent` (address) only its
        answer counts. Anybody can answer: who did is `Answer.agent`. Legacy answers don't say which question they are
        for.

        Raises `Unanswered` after `timeout` seconds. A robot may make a contract of a question, one that costs nothing.
        """
        cid = await self._cid_of(objective) if objective else ""
        writer = self.runtime.trader.writer
        by = parse_address(agent) if agent else ""
        try:
            async with asyncio.timeout(timeout):
                named = await self.parts.chain.names.model(model or self.model)
                terms = await writer.terms(
                    model=named, objective=cid or named, cost=0, token="", validator="", lifetime=None
                )
                return await Question(self.parts, writer, seconds=timeout, agent=by).ask(terms)
        except TimeoutError:
            raise Unanswered(model or self.model, timeout) from None

    async def _open_role(self, stack: AsyncExitStack, account: Account | None) -> OpenRole:
        """Open the components, and subscribe to what the handlers want."""
        self.model = await asyncio.to_thread(model_of, self._given_model)
        status: WatcherStatus | AgentStatus
        if account is None:
            network, channel = self._link = await stack.enter_async_context(watching(self.settings, drops=self.drops))
            status = WatcherStatus(network, channel, self.drops)
        else:
            runtime = self._runtime = await self._open_runtime(stack, account)
            self._place, status = runtime.parts.directory, runtime.status
            network, channel = self._link = runtime.parts.network, runtime.parts.channel
            channel.announce("agent", account.address)
        facts = log_event("agent-started", address=account and account.address, zenoh_id=network.id)
        who = f"account {account.address}" if account else "watching"
        log.info("%s on %s, Zenoh id %s", who, channel.lighthouse, network.id, extra=facts)
        market = []
        for kind, handlers in self._handlers.market.items():
            model = self.model if kind is not Result and self.model else "*"
            market.append((kind, await stack.enter_async_context(channel.subscribe(kind, model=model)), handlers))
        readings = []
        for topic, agent, listener in self._handlers.readings:
            readings.append((await stack.enter_async_context(self.readings(topic, agent=agent)), listener))
        measure = partial(status.measure, [subscription for _, subscription, _ in market])
        return OpenRole(measure, status.health, partial(self._tasks, market, readings))

    def _tasks(
        self,
        market: Sequence[tuple[type[Demand | Offer | Result], Subscription[Any], Sequence[Handler]]],
        readings: Sequence[tuple[ReadingSubscription, ReadingHandler]],
    ) -> Iterator[tuple[str, Coroutine[Any, Any, object]]]:
        if self._runtime is not None:
            yield from self._runtime.tasks()
        for kind, subscription, handlers in market:
            yield "recall", subscription.recall()
            if kind is Demand and self._runtime is not None:
                yield "demands", self._runtime.handle_demands(subscription, handlers)
            else:
                concurrency = DEMAND_LIMITS.handled if kind is Demand else 1
                yield "handlers", dispatch(subscription, handlers, concurrency=concurrency)
        for heard, listener in readings:
            yield "readings", dispatch(heard, [listener], concurrency=1)
        for seconds, handler in self._handlers.periodic:
            yield f"every {seconds:g} s", repeat(seconds, handler)

    async def _open_runtime(self, stack: AsyncExitStack, account: Account) -> AgentRuntime:
        from mesh.agent._runtime import AgentRuntime  # loads the chain, which an agent that watches does without

        make = partial(working, self.settings, account, self._given_chain, resend=self._resend, drops=self.drops)
        parts = await self._open_when_ready(stack, make)
        models = Models(parts.store, parts.exchange)
        description = await own_description(parts, models, self._given_model, self._handlers.topics)
        runtime = AgentRuntime(
            parts, self._handlers, models, description, model=self.model or "", parallel=self._parallel
        )
        return await stack.enter_async_context(runtime)

    def _opened(self) -> tuple[Network, Channel]:
        if self._link is None:
            raise ClosedError("the agent is not running", hint="use it inside `async with`")
        return self._link

    def _closed(self) -> None:
        self._link = self._runtime = None


def put_values(store: Store, values: Messages, **options: Any) -> str:
    """Put a recording of values into a store; returns its CID. Blocks on the disk. `options` are of `pack_values`."""
    with tempfile.TemporaryDirectory(prefix="aira-values-") as folder:
        path = Path(folder) / "values.mcap"
        pack_values(values, path, **options)
        return store.put_file(path)


log = logging.getLogger(__name__)


def _encoded(topic: str, value: object) -> tuple[bytes, PayloadType]:
    """The payload of a reading and its type. Raises `InputError`."""
    payload, kind = encode_described(value)
    if len(payload) > LARGEST_READING:
        raise InputError(
            f"a reading on {topic} has {len(payload):,} bytes; the most are {LARGEST_READING:,}",
            hint="send less at once, or put it into a file and publish the CID that `agent.add` returns",
            code="reading-too-large",
        )
    return payload, kind

"""The agent: what users write. A model, handlers for what happens, and one `run`."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from functools import partial
from typing import TYPE_CHECKING, Final, Self, TypeVar

from mesh.agent.components import watching, working
from mesh.agent.hooks import Handler, HandlerTopics, Hooks, hear, repeat
from mesh.agent.watcher import Watcher
from mesh.background import Background
from mesh.composition import load_account
from mesh.errors import ClosedError, ConfigurationError
from mesh.settings import load
from mesh.starting import open_when_ready, wait_for_files
from mesh.telemetry.context import LogSource, source_context
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.serving import Telemetry
from schemas import Demand, Offer, Result, Verified

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import TracebackType

    from mesh.agent.components import AgentComponents
    from mesh.agent.contract import Contract
    from mesh.agent.runtime import AgentRuntime
    from mesh.chain import Account, Chain
    from mesh.network import Channel
    from mesh.recording import Objective
    from mesh.settings import Settings

log = logging.getLogger(__name__)

LIFETIME: Final = 1000
"""Blocks for which an order is valid unless told otherwise."""
DEMANDS: Final = 32
"""Demands that handlers look at at once: the objective of one may take its time to come, or never come."""

H = TypeVar("H", bound=Handler)


class Agent:
    """A participant of the market: `agent = Agent(model)`, handlers, then `agent.run()` or `async with agent`.

    `model` is the CID of the behaviour that it serves or asks for ('' for any). With an account (a keyfile in the
    settings, or `account`) it trades and works; without one it watches the market. Nothing is opened before `run` or
    `async with`, and any number of agents live in one event loop. `chain` is an open chain to use instead of the one
    that the settings name.
    """

    def __init__(
        self,
        model: str = "",
        *,
        settings: Settings | None = None,
        account: Account | None = None,
        chain: Chain | None = None,
    ) -> None:
        self.model = model
        self.settings = load() if settings is None else settings
        self._account = account
        self._given_chain = chain
        self._hooks = Hooks()
        self._stack = AsyncExitStack()
        self._running = False
        self.telemetry = Telemetry(self.settings.metrics_listen)
        """Where its metrics and its health are told, if the settings say so."""
        self._channel: Channel | None = None
        self._worker: AgentRuntime | None = None

    def on(self, topic: str, kind: type | None = None) -> Callable[[H], H]:
        """Handle what an objective plays on `topic` (`*`: on any other): `async def handler(job, message)`.

        `message` is decoded (`Empty`, `String`, JSON data, bytes), or a msgspec Struct when `kind` names one. Messages
        come one after the other. When the last handler has returned, the job is finished with success; an exception
        (best `JobFailed("why")`) ends it without, and the promisee is refunded.
        """

        def register(handler: H) -> H:
            if topic in self._hooks.topics:
                raise ConfigurationError(f"two handlers for topic {topic}", hint="one topic has one handler")
            self._hooks.topics[topic] = (handler, kind)
            return handler

        return register

    def on_demand(self, handler: H) -> H:
        """Handle each new Demand of its model, several at once: `async def handler(demand: Verified[Demand])`."""
        return self._on_market(Demand, handler)

    def on_offer(self, handler: H) -> H:
        """Handle each new Offer of the agent's model: `async def handler(offer: Verified[Offer])`."""
        return self._on_market(Offer, handler)

    def on_result(self, handler: H) -> H:
        """Handle each new Result: `async def handler(result: Verified[Result])`."""
        return self._on_market(Result, handler)

    def on_liability(self, handler: H) -> H:
        """Handle each phase of each of the agent's jobs: `async def handler(phase: Phase, liability: Liability)`."""
        self._hooks.liabilities.append(handler)
        return handler

    def every(self, seconds: float) -> Callable[[H], H]:
        """Call the handler, which takes no argument, every so many seconds, first at the start."""

        def register(handler: H) -> H:
            self._hooks.periodic.append((seconds, handler))
            return handler

        return register

    async def __aenter__(self) -> Self:
        if self._running:
            raise ClosedError("this agent is running already", hint="one process runs it once; make another Agent")
        async with AsyncExitStack() as stack:
            self._running = True
            stack.callback(self._ended)
            await self._open(stack)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return await self._stack.__aexit__(kind, error, trace)

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM. Errors that a person can mend are one line, and exit code 1 or 2."""
        from mesh.running import run_until_stopped

        run_until_stopped(self.serve, settings=self.settings, role="agent")

    async def serve(self) -> None:
        """Serve until cancelled."""
        async with self:
            await asyncio.Event().wait()

    @property
    def parts(self) -> AgentComponents:
        """What the agent consists of while it runs. Raises `ClosedError` when it doesn't, or has no account."""
        return self._working().parts

    @property
    def channel(self) -> Channel:
        """The lighthouse's channel. Raises `ClosedError` when the agent does not run."""
        if self._channel is None:
            raise ClosedError("the agent is not running", hint="use it inside `async with`")
        return self._channel

    @property
    def address(self) -> str:
        """The account's address (EIP-55)."""
        return self.parts.signer.address

    async def offer(
        self,
        demand: Verified[Demand] | Demand | None = None,
        *,
        objective: str = "",
        cost: int = 0,
        token: str = "",
        validator: str = "",
        lighthouse_fee: int = 0,
        lifetime: int = LIFETIME,
    ) -> str:
        """Offer to do a job; returns the order's hash (hex). Sent again until it is taken or expires.

        With a `demand` the offer agrees to its terms, once its objective was found fit (see `examine`); else
        `objective` (CID), `cost` (the token's smallest unit), `token` and `validator` (names or addresses) are the
        terms, valid for `lifetime` blocks. `lighthouse_fee` is in wn, and paid to the provider.

        Raises `UnfitObjective` and branches of `ContentError` for an objective that can't be played, `ShortOfFunds`.
        """
        trader = self._working().trader
        if demand is not None:
            wanted = demand.message if isinstance(demand, Verified) else demand
            await self.examine(wanted.objective)
            terms = trader.mirrored(wanted)
        else:
            terms = await trader.terms(
                model=self.model, objective=objective, cost=cost, token=token, validator=validator, lifetime=lifetime
            )
        return await trader.offer(terms, lighthouse_fee=lighthouse_fee)

    async def examine(self, cid: str) -> Objective:
        """Look at the objective of that CID, fetched if it is not here, as before a job: what it is, how large it is,
        whether the agent's handlers take its topics. It is kept until room is needed.

        Raises `UnfitObjective`, whose `reason` is a word for programs, and branches of `ContentError`.
        """
        return await self._working().executor.examine(cid)

    async def demand(
        self,
        objective: str | Path,
        *,
        cost: int = 0,
        model: str = "",
        token: str = "",
        validator: str = "",
        validator_fee: int = 0,
        lifetime: int = LIFETIME,
    ) -> Contract:
        """Ask for a job and wait for the contract: `contract = await agent.demand(…); await contract.outcome()`.

        `objective` is a CID, or the path of a file, which is then served from here. The other terms are as for
        `offer`; the factory gets the allowance that they need. Raises `OrderExpired`, `OrderRejected`, `ShortOfFunds`.
        """
        trader = self._working().trader
        cid = objective if isinstance(objective, str) else await asyncio.to_thread(self.parts.store.put_file, objective)
        terms = await trader.terms(
            model=model or self.model, objective=cid, cost=cost, token=token, validator=validator, lifetime=lifetime
        )
        return await trader.demand(terms, validator_fee=validator_fee)

    async def contract(self, address: str) -> Contract:
        """The contract at `address`, whoever made it, to be waited for. Raises `NotALiability`."""
        return await self._working().trader.contract(address)

    async def finish(self, address: str, *, success: bool) -> str:
        """End the job of the liability at `address` now; returns the recording's CID."""
        return await self._working().executor.finish(address, success=success)

    async def _open(self, stack: AsyncExitStack) -> None:
        """Open the parts, then start what runs beside them."""
        await stack.enter_async_context(self.telemetry)
        await wait_for_files(self.settings)
        account = self._account
        if account is None and self.settings.keyfile:
            account = await asyncio.to_thread(load_account, self.settings)
        who = LogSource("agent", "" if account is None else account.address, self.settings.lighthouse_contract.lower())
        set_process_source(who)
        with source_context(who):
            await self._open_as(stack, account)

    async def _open_as(self, stack: AsyncExitStack, account: Account | None) -> None:
        """The same for `account`, or for nobody in particular."""
        if account is None:
            network, channel = await stack.enter_async_context(watching(self.settings))
            self._channel = channel
            role: Watcher | AgentRuntime = Watcher(network, channel)
            log.info("watching %s, Zenoh id %s", self.channel.lighthouse, network.id)
        else:
            role = await self._open_working(stack, account)
        assert self._channel is not None
        subscriptions = []
        for kind, handlers in self._hooks.market.items():
            model = self.model if kind is not Result and self.model else "*"
            subscription = await stack.enter_async_context(self._channel.subscribe(kind, model=model))
            subscriptions.append((subscription, handlers, DEMANDS if kind is Demand else 1))
        measure = partial(role.measure, [subscription for subscription, _, _ in subscriptions])
        stack.enter_context(self.telemetry.showing(measure=measure, health=role.health))
        # Last, and so ended first: until then, all that handlers and jobs use is open.
        tasks = await stack.enter_async_context(Background())
        if self._worker is not None:
            tasks.start(self._worker.run(), "worker")
        for subscription, handlers, at_once in subscriptions:
            tasks.start(subscription.recall(), "recall")
            tasks.start(hear(subscription, handlers, at_once=at_once), "hear")
        for seconds, handler in self._hooks.periodic:
            tasks.start(repeat(seconds, handler), f"every {seconds:g} s")

    def _ended(self) -> None:
        self._running = False
        self._channel = self._worker = None

    async def _open_working(self, stack: AsyncExitStack, account: Account) -> AgentRuntime:
        from mesh.agent.runtime import AgentRuntime  # loads web3, which an agent that watches does without

        make = partial(working, self.settings, account, self._given_chain)
        parts = await open_when_ready(stack, self.settings, make, role="agent", on_wait=self.telemetry.starting)
        performer = HandlerTopics(self._hooks) if self._hooks.topics else None
        worker = self._worker = AgentRuntime(parts, performer=performer, witnesses=self._hooks.liabilities)
        self._channel = parts.channel
        self._channel.announce("agent", account.address)
        log.info("account %s on %s, Zenoh id %s", account.address, parts.channel.lighthouse, parts.network.id)
        return worker

    def _on_market(self, kind: type[Demand | Offer | Result], handler: H) -> H:
        self._hooks.market.setdefault(kind, []).append(handler)
        return handler

    def _working(self) -> AgentRuntime:
        self.channel  # raises when the agent is not running  # noqa: B018
        if self._worker is None:
            raise ConfigurationError(
                "this agent has no account, it only watches",
                hint="give it one: keyfile and keyfile_password_file in the settings",
            )
        return self._worker

"""The agent, which users write: a model, handlers, and `run`."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, cast

from mesh.agent.components import watching, working
from mesh.agent.demands import HANDLED
from mesh.agent.handlers import HandlerDecorators, check_model, dispatch, repeat
from mesh.agent.own_model import derived, model_of, own_description
from mesh.agent.reading_agent import ReadingAgent
from mesh.agent.status import WatcherStatus
from mesh.background import Background
from mesh.composition import load_account
from mesh.flood import Drops
from mesh.log_context import LogSource, log_event, source_context
from mesh.starting import open_when_ready, serve_on_each_chain, wait_for_files
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.serving import Telemetry
from mesh.work.models import Models
from mesh.work.outbox import RESEND
from schemas import Demand, Result

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import AsyncExitStack
    from pathlib import Path

    from mesh.agent.runtime import AgentRuntime
    from mesh.chain import Account, Chain
    from mesh.retry import RetryPolicy
    from mesh.settings import Settings
    from schemas.model import ModelDescription, ModelLimits

log = logging.getLogger(__name__)


class DescriptionFields(TypedDict, total=False):
    """The optional arguments of `Agent.model_description`: the fields of `ModelDescription` that handlers don't say."""

    description: str
    success: str
    price: str
    seconds: float
    limits: ModelLimits


class Agent(HandlerDecorators, ReadingAgent):
    """A participant of the market: `agent = Agent(model)`, handlers, then `agent.run()` or `async with agent`.

    `model` is the CID of the behaviour that it offers or demands ('' for any), or the path of the model's file, which
    it then serves. If the model has a description, the handlers must fit it, and objectives are checked against it.
    With an account (`account`, or a keyfile in the settings) it trades and works; without one it only watches the
    market. It opens nothing before `run` or `async with`. Any number of agents can run in one event loop. `chain`, if
    given, is an open chain to use instead of the one that the settings name; `resend` is how often messages without
    effect are sent again.
    """

    def __init__(
        self,
        model: str | Path = "",
        *,
        settings: Settings | None = None,
        account: Account | None = None,
        chain: Chain | None = None,
        resend: RetryPolicy = RESEND,
    ) -> None:
        check_model(model)
        HandlerDecorators.__init__(self)
        ReadingAgent.__init__(self, model_of(model, missing=""), settings)
        self._given_model = model
        self._account = account
        self._given_chain = chain
        self._resend = resend
        self.telemetry = Telemetry(self.settings.metrics_listen)
        """Serves its metrics and its health if the settings say where."""
        self.drops = Drops()
        """Counts what was dropped, of what strangers sent."""

    def __repr__(self) -> str:
        who = f", account={self.address}" if self._runtime is not None else ""
        return f"Agent(model={self.model or '(any)'}{who})"

    def model_description(
        self, title: str, *, result: Mapping[str, Any] | None = None, **fields: Unpack[DescriptionFields]
    ) -> ModelDescription:
        """A description of what the agent's handlers take, by the types of their messages.

        `result` has the type of what they publish, by topic. Limits, titles and units are those of `msgspec.Meta`:
        `Annotated[float, Meta(ge=0, le=2, title="Speed", extra_json_schema={"unit": "m/s"})]`. Its `cid` is the model.
        Raises `InvalidDescription`.
        """
        return derived(self._handlers.topics, result or {}, {"title": title, **fields})

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM. Prints errors that people can fix in one line, with exit code 1 or 2."""
        from mesh.running import run_until_stopped

        run_until_stopped(self.serve, settings=self.settings, role="agent")

    async def serve(self) -> None:
        """Serve until cancelled, also when a development chain is started afresh."""
        place: Path | None = None

        async def on_one_chain(settings: Settings) -> None:
            nonlocal place
            self.settings = settings
            async with self:
                place = None if self._runtime is None else self._runtime.parts.directory
                await asyncio.Event().wait()

        if self._given_chain is None:
            await serve_on_each_chain(self.settings, on_one_chain, place=lambda: place)
        else:
            await on_one_chain(self.settings)

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.callback(self._closed)
        await stack.enter_async_context(self.telemetry)
        await wait_for_files(self.settings)
        self.model = await asyncio.to_thread(model_of, self._given_model)
        account = self._account
        if account is None and self.settings.keyfile:
            account = await asyncio.to_thread(load_account, self.settings)
        address, lighthouse = "" if account is None else account.address, self.settings.lighthouse_contract.lower()
        source = LogSource("agent", address, lighthouse)
        set_process_source(source)
        with source_context(source):
            await self._open_as(stack, account)

    async def _open_as(self, stack: AsyncExitStack, account: Account | None) -> None:
        """Open the components, then start the tasks."""
        status: WatcherStatus | AgentRuntime
        if account is None:
            network, channel = await stack.enter_async_context(watching(self.settings, drops=self.drops))
            status = WatcherStatus(network, channel, self.drops)
            self._network, self._channel = network, channel
        else:
            status = self._runtime = await self._open_runtime(stack, account)
            network, channel = status.parts.network, status.parts.channel
            self._network, self._channel = network, channel
            channel.announce("agent", account.address)
        facts = log_event("agent-started", address=account and account.address, zenoh_id=network.id)
        who = f"account {account.address}" if account else "watching"
        log.info("%s on %s, Zenoh id %s", who, channel.lighthouse, network.id, extra=facts)
        subscriptions = []
        for kind, handlers in self._handlers.market.items():
            model = self.model if kind is not Result and self.model else "*"
            subscription = await stack.enter_async_context(channel.subscribe(kind, model=model))
            subscriptions.append((kind, subscription, handlers))
        measure = partial(status.measure, [subscription for _, subscription, _ in subscriptions])
        stack.enter_context(self.telemetry.showing(measure=measure, health=status.health))
        # The tasks are entered last, so they end first: what handlers and jobs use is open until then.
        tasks = await stack.enter_async_context(Background())
        if self._runtime is not None:
            tasks.start(self._runtime.run(), "runtime")
        tasks.start(self.drops.run(), "drops")
        for kind, subscription, handlers in subscriptions:
            tasks.start(subscription.recall(), "recall")
            if kind is Demand and self._runtime is not None:
                tasks.start(self._runtime.handle_demands(cast("Any", subscription), handlers), "demands")
            else:
                tasks.start(dispatch(subscription, handlers, concurrency=HANDLED if kind is Demand else 1), "handlers")
        for topic, agent, listener in self._handlers.readings:
            heard = await stack.enter_async_context(self.readings(topic, agent=agent))
            tasks.start(dispatch(heard, [listener], concurrency=1), f"readings on {topic}")
        for seconds, handler in self._handlers.periodic:
            tasks.start(repeat(seconds, handler), f"every {seconds:g} s")

    async def _open_runtime(self, stack: AsyncExitStack, account: Account) -> AgentRuntime:
        from mesh.agent.runtime import AgentRuntime  # loads the chain, which an agent that watches does without

        make = partial(working, self.settings, account, self._given_chain, resend=self._resend, drops=self.drops)
        parts = await open_when_ready(stack, self.settings, make, role="agent", on_wait=self.telemetry.starting)
        models = Models(parts.store, parts.exchange)
        description = await own_description(parts, models, self._given_model, self._handlers.topics)
        runtime = AgentRuntime(parts, self._handlers, models, description, model=self.model or "")
        return await stack.enter_async_context(runtime)

    def _closed(self) -> None:
        self._network = self._channel = self._runtime = None

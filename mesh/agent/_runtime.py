"""An agent with an account at work: it follows the chain, does its jobs, trades, and offers its services.

`AgentRuntime` says what happens on the chain means for the agent: its trade, its jobs, its token events (`on_event`,
`on_revert`), and what it does until it is cancelled (`tasks`). Handling is idempotent: see `mesh.role.following`.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from contextlib import suppress
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, Final

import zenoh
from msgspec.structs import replace

from mesh.agent._notifications import Notifier, OwnerWatch
from mesh.agent._owner_rules import OwnerRules, accepted_values
from mesh.agent._profile import OwnProfile
from mesh.agent._services import offer_services
from mesh.agent.components import AgentComponents
from mesh.agent.contracts import ContractReports, Outcome
from mesh.agent.demands import Acceptance, DemandDispatcher, Quoting
from mesh.agent.handlers import call
from mesh.agent.jobs import Executor, check_stop, reason_in, stop_devices
from mesh.agent.ledger import TO_BE_DONE, UNFINISHED, Phase, advance, result_identity
from mesh.agent.objectives import Objectives
from mesh.agent.trade import Trader
from mesh.agent.validators import ValidatorDirectory
from mesh.base.background import call_in_loop
from mesh.base.flood import Rate, RateLimiter
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import liability_context, log_event, with_liability_context
from mesh.chain import (
    Approval,
    Finalized,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    NotOffered,
    RequestRefused,
    Reverted,
    Transfer,
)
from mesh.errors import AiraError, ChainError, ConfigurationError
from mesh.network.services import answering, declared
from mesh.role.following import follow_chain
from mesh.role.local_stop import ANSWER_SECONDS, LocalAnswer, LocalRequest, listening, stop_folder
from mesh.role.program import RoleStatus
from mesh.role.refunds import DueRefunds
from mesh.telemetry.logs import LogService
from mesh.telemetry.metrics import MetricFamily, by_label, counter, gauge
from schemas import (
    ZERO_ADDRESS,
    Demand,
    Permit,
    Result,
    Withdrawal,
    decode,
    event_selector,
    message_hash,
    parse_address,
)
from schemas.cid import is_cid
from schemas.keys import EthEventKey, EventKey, ProgressKey, PublishedPhase, market_selector
from schemas.rpc import ApprovalEvent, TransferEvent
from schemas.status import ALIVE, OFF, StoreUse, Work

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Sequence
    from contextlib import AbstractAsyncContextManager, AbstractContextManager, AsyncExitStack

    from mesh.agent.handlers import Handler, Handlers
    from mesh.agent.ledger import JobRecord
    from mesh.chain import ChainEvent
    from mesh.network import Subscription
    from mesh.role.following import Created
    from mesh.role.models import Models
    from schemas import Liability, Offer, Record
    from schemas.model import ModelDescription
    from schemas.records import ControlRobot, DeviceStop, RobotControl
    from schemas.verdicts import ValidatorReport

log = logging.getLogger(__name__)

PUBLISHED: Final[dict[Phase, PublishedPhase]] = {
    Phase.INCOMING: "incoming",
    Phase.READY: "ready",
    Phase.COMPLETE: "complete",
    Phase.FINALIZED: "finalized",
}
"""The phases that are published on the agent's keys, with their names there."""
ASKED: Final = Rate(per_second=20.0, burst=100)
"""Queries for phases that are answered."""


def answering_phases(parts: AgentComponents, executor: Executor) -> AbstractAsyncContextManager[None]:
    """Meanwhile answer queries on the keys of the agent's events with the present phase of each job that they name.

    A query for all jobs (`*`) is answered with those that have not ended. A job that is played is `ready`, and how far
    it is.
    """
    agent = parts.signer.address

    async def answer(query: zenoh.Query) -> None:
        chunks = str(query.key_expr).split("/")
        named = chunks[4] if len(chunks) > 4 else ""
        jobs = await parts.ledger.jobs(UNFINISHED) if named == "*" else []
        for address in [job.liability.address for job in jobs] or [parse_address(named)]:
            if (job := await parts.ledger.job(address)) is not None:
                event = EventKey(agent, address, PUBLISHED.get(job.phase, "ready"))
                replies = {str(event): (await executor.read(address)).encode()}
                if (run := executor.runs.get(address)) is not None and (position := run.playback) is not None:
                    replies[str(ProgressKey(agent, address))] = position.encode()
                for key, payload in replies.items():
                    if query.key_expr.intersects(zenoh.KeyExpr(key)):
                        query.reply(key, payload, encoding="application/json")

    return answering(parts.network.session, event_selector(agent), answer, ASKED, parts.drops)


class TokenEvents:
    """Publishes token events of `account` on `aira/agent/{account}/eth/event/transfer` or `…/approval`, with `put`.

    An event that is reverted and happens again is published once. One that does not happen again was published in vain,
    and after a crash in the middle of a block its events are published again: read balances from the chain, don't add
    up events.
    """

    def __init__(self, put: Callable[[str, bytes], None], account: str) -> None:
        self._put = put
        self._account = account
        self._reverted: deque[Transfer | Approval] = deque(maxlen=1_000)

    def publish(self, event: Transfer | Approval) -> None:
        """Publish an event if it concerns the account and was not published before it was reverted."""
        parties, record = _record(event)
        if self._account not in parties:
            return
        if event in self._reverted:
            self._reverted.remove(event)
            return
        kind: Final = "transfer" if isinstance(event, Transfer) else "approval"
        self._put(str(EthEventKey(self._account, kind)), record.encode())

    def revert(self, event: Transfer | Approval) -> None:
        """A reorganisation reverted the event; it may happen again in another block."""
        if self._account in _record(event)[0]:
            self._reverted.append(event)


def _record(event: Transfer | Approval) -> tuple[tuple[str, str], Record]:
    """The accounts that an event concerns, and its record."""
    match event:
        case Transfer(sender, recipient, value):
            return (sender, recipient), TransferEvent(sender, recipient, value)
        case Approval(owner, spender, value):
            return (owner, spender), ApprovalEvent(owner, spender, value)


SOON: Final = 3
"""Blocks that leave a Result unsettled before the chain is asked when it would be late, and between two attempts."""
JUDGED: Final = frozenset({"NotTheValidator", "RefusedByValidator"})
"""How the contracts refuse a Result that only a validator can finalize."""


class LateResults:
    """Finalizes liabilities by the account's own Results before they can be refunded, if no provider does.

    The original contracts offer no finalization without a turn; there it does nothing.
    """

    def __init__(self, parts: AgentComponents) -> None:
        self._parts = parts
        self._liabilities = parts.chain.liabilities
        self._late_from: dict[str, float] = {}  # block, by liability; infinite once nothing more is to be done
        self._since: dict[str, int] = {}  # the block at which its Result was seen first, by liability

    async def run(self) -> None:
        """Look at the unsettled Results after each block, until cancelled."""
        head = self._parts.chain_head
        while True:
            unsettled = await self._parts.ledger.outbox(head=head.contract_block)
            results = [decode(one.payload) for one in unsettled if one.kind == Result.kind]
            waiting = {result.liability: result for result in results if isinstance(result, Result)}
            self._late_from = {address: block for address, block in self._late_from.items() if address in waiting}
            self._since = {address: self._since.get(address, head.contract_block) for address in waiting}
            for address, result in waiting.items():
                with liability_context(address):
                    await self._finalize_if_late(result)
            await head.reached(head.head + 1)

    async def _finalize_if_late(self, result: Result) -> None:
        address, head = result.liability, self._parts.chain_head.contract_block
        try:
            if address not in self._late_from:
                if head - self._since[address] < SOON:
                    return
                refundable = await self._liabilities.refundable_from(address)
                # A Result is late when a quarter of the blocks before the refund are left, or fewer than 20.
                self._late_from[address] = refundable - max(20, (refundable - self._since[address]) // 4)
            if head < self._late_from[address]:
                return
            settled = await self._liabilities.finalize_without_turn(result)
        except (NodeUnreachable, RequestRefused, NotALiability) as error:
            log.debug("looking at the result again after the next block: %s", error)
        except (NotOffered, Reverted) as error:
            is_final = isinstance(error, NotOffered) or error.reason in (*JUDGED, "WrongSigner")  # of another account
            # Else somebody's transaction may be pending that finalizes it, and fail.
            self._late_from[address] = inf if is_final else head + SOON
            log.debug("the contract is not finalized by its result: %s", error)
            if isinstance(error, Reverted) and error.reason in JUDGED:
                facts = log_event("verdict-late", code=error.reason)
                log.warning("the validator has not judged the result, and the cost can be refunded soon", extra=facts)
        except ChainError as error:
            facts = log_event("late-result-waits", code=error.code)
            log.warning("no provider finalized the contract, and finalizing it failed: %s", error, extra=facts)
        else:
            self._late_from[address] = inf
            facts = log_event("late-result-finalized", success=result.success, gas=settled.gas_used)
            log.warning("finalized without a provider, because none did in time", extra=facts)


class AgentRuntime(Lifecycle):
    """The working side of an agent: `async with AgentRuntime(components, handlers) as runtime`, then its `tasks`."""

    title = "agent"

    def __init__(
        self,
        parts: AgentComponents,
        handlers: Handlers,
        models: Models,
        description: ModelDescription | None = None,
        *,
        model: str = "",
        parallel: int = 1,
    ) -> None:
        topics = handlers.topics or None
        self.parts = parts
        self._account = parts.signer.address
        self.models = models
        self.validators = ValidatorDirectory(parts.network.session, parts.channel, parts.chain)
        self.reports = ContractReports(parts, self._on_report if handlers.reports else None)
        self.trader = Trader(parts, self.reports)
        allowed = accepted_values(parts.settings.accept_values)
        self.objectives = Objectives(parts.store, parts.exchange, parts.settings, topics, description, allowed)
        self.executor = Executor(
            parts,
            objectives=self.objectives,
            handlers=topics,
            on_phase=self._on_phase,
            on_stop=handlers.stops,
            parallel=parallel,
            is_paid_when_stopped=description is not None and description.on_stop == "paid",
        )
        price = "" if description is None else description.price
        self.rules = OwnerRules(
            parts, lambda: len(self.executor.at_hand) + len(self.trader.answers), self.executor.hold, price=price
        )
        self.trader.full = self.rules.full
        self.notifier = Notifier(parts.settings, parts.signer.address)
        self.trader.on_offer = self._on_offer
        self.refunds = DueRefunds(parts.chain, parts.chain_head, parts.outages, self._earlier_contracts)
        self.token_events = TokenEvents(parts.channel.put, parts.signer.address)
        # Else it may run beside the account's robot, as the commands of a person do.
        self._is_robot = bool(handlers.topics) or Demand in handlers.market
        self.status = AgentStatus(parts, self.executor, model=model if self._is_robot else "")
        self.profile = OwnProfile(parts, self.executor, self.rules, description, model=model)
        self._handlers = handlers
        self._description = description
        self._new: Created | None = None
        """The only contract that was created in the blocks that were read last."""
        self._model = model

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self.notifier)
        await stack.enter_async_context(self.reports)
        await stack.enter_async_context(self.trader)
        if self._is_robot or self.parts.settings.enable_executor:
            await self.rules.open()
        if self._is_robot:
            await self.trader.withdraw_earlier_offers()
            await self.profile.prepare()
            await stack.enter_async_context(self.profile.serve())
        await stack.enter_async_context(answering_phases(self.parts, self.executor))
        services = self.parts.services
        has_handlers = bool(self._handlers.topics)
        offer_services(self.parts, self.executor, self.stop, self.control, has_handlers=has_handlers)
        if decide := self._handlers.market.get(Demand):
            quoting = Quoting(
                self.parts,
                self.profile,
                self.rules,
                self.objectives,
                self._handlers.quotes,
                self._description,
                model=self._model,
            )
            services.offer("quote", quoting.quote)
            acceptance = Acceptance(self.parts, self.trader, self.rules, self.objectives, decide, model=self._model)
            services.offer("accept", acceptance.accept)
        if self.parts.settings.enable_executor:
            ask = partial(self._ask_from_thread, asyncio.get_running_loop())
            folder = stop_folder(self.parts.settings)
            stack.enter_context(listening(folder, f"agent-{self._account}", ask))
        services.offer("logs", LogService("agent", self.parts.signer.address).logs)
        services.offer("status", self.status.status)

    def tasks(self) -> Iterator[tuple[str, Coroutine[Any, Any, object]]]:
        if self.parts.settings.enable_executor:
            yield "executor", self._do_jobs()
        yield "outbox", self.parts.outbox.run()
        yield "listener", self._follow_chain()
        yield "late results", LateResults(self.parts).run()
        yield "refunds", self.refunds.run()
        yield "reports on earlier contracts", self._follow_earlier()
        if self._is_robot:
            yield "profile", self.profile.run()
            yield from OwnerWatch(self.parts, self.notifier).tasks()
            if self.parts.settings.hours:
                yield "hours", self._follow_hours()

    async def _follow_hours(self) -> None:
        """Let the profile say when the robot closes, and when it opens again."""
        while True:
            self.profile.changed()
            await asyncio.sleep(5.0)

    async def _do_jobs(self) -> None:
        await self.finalize_ended()
        await self.executor.run()

    async def _follow_chain(self) -> None:
        """Read the chain from where the account's agent stopped. Raises `ChainWentBack` and `UnknownName`."""
        parts, chain, token = self.parts, self.parts.chain, ""
        if parts.settings.erc20_token:
            find_token = partial(chain.tokens.address, parts.settings.erc20_token)
            token = await chain.retrying(find_token, outages=parts.outages)
        await follow_chain(
            self,
            chain,
            parts.chain_head,
            parts.outages,
            store=parts.ledger,
            token=token,
            parties=[self._account],
            choose=self._choose,
            read=self._read_created,
        )

    async def on_event(self, event: ChainEvent, created: Created | None, block: int) -> None:
        """Act on an event of the chain."""
        match event:
            case NewLiability():
                assert created is not None
                liability, orders = created
                with liability_context(event.liability):
                    if self._account in (liability.promisor, liability.promisee):
                        await self.new_liability(liability, demand_hash=orders[0], offer_hash=orders[1], created=block)
                    if self._account != liability.promisor:
                        await self.trader.taken(liability, orders[0])
            case Finalized():
                await self.finalized(event.liability, success=event.success, result=event.result, ended=block)
            case Transfer() | Approval():
                self.token_events.publish(event)

    async def on_revert(self, event: ChainEvent) -> None:
        """Undo an event that a reorganisation has reverted."""
        match event:
            case NewLiability():
                await self.liability_reverted(event.liability)
            case Finalized():
                await self.finalization_reverted(event.liability)
            case Transfer() | Approval():
                self.token_events.revert(event)

    async def on_reorganised(self, block: int) -> None:
        """Allowances and withdrawals may be reverted, too."""
        self.trader.reorganised()

    async def on_head(self, block: int) -> None:
        """All of `block` has been handled. After a reorganisation it may be lower than before."""
        await self.parts.outbox.expire(self.parts.chain_head.contract_block)
        await self.trader.new_head(self.parts.chain_head.contract_block)

    async def finalize_ended(self) -> None:
        """Finalize the jobs that ended while the agent was away, before any of them is played to the device again."""
        for job in await self.parts.ledger.jobs(TO_BE_DONE):
            read = partial(self.parts.chain.liabilities.get, job.liability.address)
            try:
                now = await self.parts.chain.retrying(read, outages=self.parts.outages)
            except (NotALiability, NoContracts):  # reverted, which the listener will find
                continue
            if now.is_finalized:
                await self.finalized(now.address, success=now.is_success, result=now.result)

    async def _choose(self, created: Sequence[str], ended: Sequence[str]) -> set[str]:
        """Of the liabilities that were created or ended in some blocks, those that may concern this agent."""
        chosen: set[str] = set()
        self._new = None
        if len(created) == 1:  # the same call reads all that is needed of it
            new = await self.parts.chain.liabilities.get_with_orders(created[0])
            if self._concerns(new[0].promisee, new[0].promisor):
                self._new, chosen = new, set(created)
        elif created:  # one call for all, because most are between others
            parties = await self.parts.chain.liabilities.parties(created)
            chosen = {one for one, named in zip(created, parties, strict=True) if self._concerns(*named)}
        if ended:
            held = await self.parts.ledger.holds([*ended, *map(result_identity, ended)])
            watched = self.trader.contracts
            chosen |= {one for one in ended if one in held or result_identity(one) in held or one in watched}
        return chosen

    async def _read_created(self, addresses: Sequence[str]) -> Sequence[Created]:
        """The records of new contracts that were chosen; the only one of the blocks that were read was read then."""
        new, self._new = self._new, None
        if new is not None and addresses == [new[0].address]:
            return [new]
        return await self.parts.chain.liabilities.get_all_with_orders(addresses)

    def _concerns(self, promisee: str, promisor: str) -> bool:
        """Whether a new contract is this account's, or may be of a demand that it has answered."""
        return self._account in (promisee, promisor) or promisee in self.trader.answered

    @with_liability_context
    async def new_liability(
        self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes, created: int | None = None
    ) -> None:
        """A contract was created, in the block `created`, that names this account: as promisee, promisor, or both."""
        does_jobs = self.parts.settings.enable_executor
        if does_jobs and liability.promisor == self._account and not liability.is_finalized:
            self.executor.at_hand.add(liability.address)  # before the offer is none any more
        await self.trader.matched(liability, demand_hash=demand_hash, offer_hash=offer_hash)
        if liability.promisee == self._account and not liability.is_finalized:
            self.refunds.created(liability)
        if liability.promisor != self._account:
            return
        if not does_jobs:
            if not liability.is_finalized:  # for the account's next run that does jobs, or one beside this
                await self.parts.ledger.add_job(liability)
            return
        await self.executor.wait_until_open()
        if liability.is_finalized:
            if await self.parts.ledger.bring_back(liability.address):
                await self.finalized(liability.address, success=liability.is_success, result=liability.result)
            return
        address, is_known = liability.address, not await self.parts.ledger.add_job(liability)
        job = await self.parts.ledger.job(address)
        # Another program of the account may have added it, and left it to this one.
        if job is None or (is_known and (job.phase is not Phase.INCOMING or address in self.executor.preparing)):
            if created is not None and address in self.executor.created_in:  # again, after a reorganisation
                self.executor.created_in[address] = created
            if job is None or job.phase not in TO_BE_DONE:
                self.executor.at_hand.discard(address)
            return
        if job.result is not None:
            self.executor.at_hand.discard(address)
            await self._owe_result(job)
            return
        facts = log_event("job-accepted", model=liability.model, objective=liability.objective, cost=liability.cost)
        log.info("new job, model %s, objective %s", liability.model, liability.objective, extra=facts)
        await self._on_phase(Phase.INCOMING, liability)
        self.executor.prepare(liability, created=created)

    @with_liability_context
    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted a contract: its job is set aside, and our order is sent again."""
        async with self.executor.halted(address) as job:
            if job is not None:
                await self.parts.ledger.set_aside(address)
                await self.parts.outbox.settle(result_identity(address))
                log.warning("the liability was reverted; its job waits", extra=log_event("job-set-aside"))
        self.refunds.ended(address)
        await self.trader.liability_reverted(address)

    @with_liability_context
    async def finalized(self, address: str, *, success: bool, result: str, ended: int | None = None) -> None:
        """A contract has paid (`success`) or refunded, in the block `ended`. `result` is the CID of its recording."""
        async with self.executor.halted(address) as job:
            # In this order: after a crash in between, the block is handled again and finds the job unfinished.
            await self.parts.outbox.settle(result_identity(address))  # also one that was signed by request
            if job is not None and job.phase is not Phase.FINALIZED:
                await self.parts.ledger.set_phase(address, advance(address, job.phase, Phase.FINALIZED))
        if job is not None and job.phase is not Phase.FINALIZED:
            facts = log_event("job-finalized", success=success)
            log.info("finalized, %s", "paid" if success else "refunded", extra=facts)
            ended_job = replace(job.liability, is_finalized=True, is_success=success, result=job.result or "")
            await self._on_phase(Phase.FINALIZED, ended_job)
        self.refunds.ended(address)
        outcome = Outcome(success=success, result=result)
        self.trader.contracts.finalized(address, outcome, self.parts.chain_head.head if ended is None else ended)
        await self.trader.contracts.settle()

    @with_liability_context
    async def finalization_reverted(self, address: str) -> None:
        """A reorganisation reverted the end of a contract: the Result of its job, if it has one, is sent again."""
        self.trader.contracts.end_reverted(address)
        self.refunds.end_reverted(address)
        async with self.executor.halted(address) as job:
            if job is not None and job.result is not None:
                log.warning("the finalization was reverted", extra=log_event("finalization-reverted"))
                await self._owe_result(job)

    async def _owe_result(self, job: JobRecord) -> None:
        """Send the Result of a complete job again."""
        assert job.result is not None
        address, success = job.liability.address, bool(job.success)
        await self.executor.owe_result(address, success=success, result=job.result, note=job.note)
        await self.parts.outbox.send_new()

    async def _earlier_contracts(self) -> list[str]:
        return [address for _, address in await self.parts.ledger.contracts("demand")]

    async def _note_permits(self, permits: Subscription[Permit]) -> None:
        """Remember the permits beside demands: whose maker can pay goes by them, too."""
        await permits.recall()
        async for permit in permits:
            if not self.parts.chain.funds.note(permit.message):
                permits.forget(permit, after=60.0)  # until then copies are dropped unread

    async def handle_demands(self, subscription: Subscription[Demand], handlers: Sequence[Handler]) -> None:
        """Call the handlers with the demands of a subscription whose makers can pay, until cancelled."""
        parts, tokens = self.parts, self.parts.chain.tokens
        token = await parts.chain.retrying(partial(tokens.address, parts.settings.erc20_token), outages=parts.outages)
        dispatcher = DemandDispatcher(
            subscription, handlers, parts, self.trader, self.rules, self.objectives, token=token
        )
        async with (
            parts.channel.subscribe(Withdrawal) as withdrawals,
            parts.channel.subscribe(Permit) as permits,
            asyncio.TaskGroup() as tasks,
        ):
            tasks.create_task(self._note_permits(permits), name="permits")
            tasks.create_task(dispatcher.run(), name="demands")
            with self._hearing_of_contracts():
                async for withdrawal in withdrawals:
                    await self.trader.demand_withdrawn(withdrawal)

    def _hearing_of_contracts(self) -> AbstractContextManager[None]:
        """Meanwhile look at the chain when a provider says that it has a new contract of the model.

        Until the next poll, an offer for a demand that another robot got would match the next one. Anybody may say it,
        so this is limited, and done only while there are demands that the agent has answered.
        """
        loop, session, limiter = (
            asyncio.get_running_loop(),
            self.parts.network.session,
            RateLimiter(per_sender=Rate(per_second=5.0, burst=10)),
        )
        heads = self.parts.chain.node.heads

        def look() -> None:
            if len(self.trader.answered) and heads.latest is not None and limiter.allow(""):
                heads.expect(heads.latest.number + 1)

        model = self._model if is_cid(self._model) else "*"
        selector = market_selector(self.parts.channel.lighthouse, "created", model)
        return declared(session, session.declare_subscriber(selector, lambda _sample: call_in_loop(loop, look)))

    async def stop(self, address: str, *, why: str, by: str, code: str = "") -> tuple[DeviceStop, ...]:
        """Stop a job; if the agent is held then, it withdraws its offers. As `Executor.stop`."""
        devices = await self.executor.stop(address, why=why, by=by, code=code)
        if self.executor.hold.is_held:
            await self.trader.take_back_offers("the robot was stopped")
            self.profile.changed()
        return devices

    async def stop_all(self, why: str) -> LocalAnswer:
        """Stop the jobs that have begun, for the robot's owner, who holds the agent; without one, tell the devices."""
        jobs, stops = tuple(self.executor.runs), []
        if not jobs:
            stops = [asyncio.to_thread(stop_devices, self.parts.network.session, self._account, why)]
        stops += [self.stop(address, why=why, by=self._account) for address in jobs]
        devices: dict[str, DeviceStop] = {}
        for outcome in await asyncio.gather(*stops, return_exceptions=True):
            if isinstance(outcome, BaseException):
                log.warning("a job could not be stopped: %s", outcome, extra=log_event("job-not-stopped"))
            else:
                devices |= {one.device: one for one in outcome}
        await self.trader.take_back_offers("the robot was stopped")
        self.profile.changed()
        told = [
            f"{one.device} has {'heard it' if one.heard else f'not heard it: {one.detail}'}" for one in devices.values()
        ]
        detail = "; ".join((f"stopped {len(jobs)} job{'' if len(jobs) == 1 else 's'}", *told))
        return LocalAnswer(who=f"agent {self._account}", heard=True, detail=detail)

    async def control(self, asked: ControlRobot) -> RobotControl:
        """Do what the owner of this agent wants; returns what is in effect then.

        Raises `InvalidAmount`, `InvalidAddress`, `InputError`, and an `AiraError` if it can't be held or released.
        """
        stopped, hold = "", self.executor.hold
        try:
            if asked.stop is not None:
                check_stop(asked.stop)
                try:
                    await asyncio.to_thread(hold.hold, asked.stop)
                finally:
                    stopped = (await self.stop_all(asked.stop)).detail
            elif asked.release:
                await asyncio.to_thread(hold.release)
        except OSError as error:
            raise ConfigurationError(f"the data folder can't be written to: {error.strerror}") from None
        await self.rules.change(asked)
        if asked.release and hold.is_held:
            why, hint = "all robots of its machine were stopped there", "`aira stop --release` there releases them"
            raise AiraError(why, hint=hint, code="held-on-machine")
        if asked.paused:
            await self.trader.take_back_offers("its owner has paused it")
        self.profile.changed()
        notifier = self.notifier
        return replace(self.rules.control, stopped=stopped, notify=notifier.targets(), events=tuple(notifier.recent))

    async def _ask(self, asked: LocalRequest) -> LocalAnswer:
        if asked.control is None:
            return await self.stop_all(asked.why)
        who = f"agent {self._account}"
        try:
            return LocalAnswer(who=who, heard=True, control=await self.control(asked.control))
        except AiraError as error:
            return LocalAnswer(who=who, heard=False, detail=str(error), hint=error.hint, code=error.code)

    def _ask_from_thread(self, loop: asyncio.AbstractEventLoop, asked: LocalRequest) -> LocalAnswer:
        try:
            return asyncio.run_coroutine_threadsafe(self._ask(asked), loop).result(ANSWER_SECONDS)
        except TimeoutError:
            return LocalAnswer(who=f"agent {self._account}", heard=False, detail="it is busy and has not done it yet")

    async def require_fit(self, objective: str, model: str) -> None:
        """Raise `ObjectiveUnfit` if an objective does not fit the model's description, as far as both are available."""
        description = await self.models.find(model)
        if description is not None:
            await self.objectives.require_fit(objective, description)

    async def _follow_earlier(self) -> None:
        """Ask for the reports on contracts of earlier runs that have not ended."""
        parts = self.parts
        for job in await parts.ledger.jobs(UNFINISHED):
            self.reports.follow(job.liability)
        for payload, address in await parts.ledger.contracts("demand"):
            demand = decode(payload)
            if isinstance(demand, Demand) and demand.validator != ZERO_ADDRESS:
                read = partial(parts.chain.liabilities.get, address)
                with suppress(NotALiability):
                    liability = await parts.chain.retrying(read, outages=parts.outages)
                    if not liability.is_finalized:
                        self.reports.follow(liability)

    async def _on_report(self, report: ValidatorReport) -> None:
        for handler in self._handlers.reports:
            await call(handler, report)

    async def _on_phase(self, phase: Phase, liability: Liability) -> None:
        self.profile.changed()
        if phase in PUBLISHED:
            key = str(EventKey(self.parts.signer.address, liability.address, PUBLISHED[phase]))
            self.parts.channel.put(key, liability.encode())
        await self._notify(phase, liability)
        for handler in self._handlers.liabilities:
            await call(handler, phase, liability)

    def _on_offer(self, offer: Offer, customer: str) -> None:
        """Notify of an offer, which may become a job."""
        facts = {"order": message_hash(offer).hex(), "customer": customer, "model": offer.model}
        facts |= {"objective": offer.objective, "cost": str(offer.cost), "token": offer.token}
        self.notifier.notify("job-offered", facts, about=facts["order"])

    async def _notify(self, phase: Phase, liability: Liability) -> None:
        """Notify of what has become of a job."""
        facts = {"liability": liability.address, "customer": liability.promisee, "model": liability.model}
        facts |= {"objective": liability.objective, "cost": str(liability.cost), "token": liability.token}
        tell = partial(self.notifier.notify, about=liability.address)
        match phase:
            case Phase.RUNNING:
                tell("job-begun", facts)
            case Phase.COMPLETE if not liability.is_success:
                job = await self.parts.ledger.job(liability.address)
                reason = reason_in("" if job is None else job.note)
                tell("job-failed", facts | {"reason": reason.text, "code": reason.code, "result": liability.result})
            case Phase.FINALIZED:
                tell("job-paid" if liability.is_success else "job-refunded", facts | {"result": liability.result})


class AgentStatus(RoleStatus[AgentComponents]):
    """The metrics, the health and the service `status` of an agent with an account; `model` is a robot's."""

    role = "agent"

    def __init__(self, parts: AgentComponents, executor: Executor, *, model: str = "") -> None:
        super().__init__(parts)
        self._executor = executor
        self._model = model

    def health(self) -> dict[str, str]:
        """The state of each part; the parts are the nodes of the legacy stack. The signer's key is in memory."""
        executor = ALIVE if self._executor.is_running else "has not begun"
        shared = super().health()
        return {
            "executor": executor if self.parts.settings.enable_executor else OFF,
            "channel": shared["channel"],
            "signer": ALIVE,
            "listener": shared["listener"],
        }

    async def _own_status(self, store: StoreUse) -> dict[str, Any]:
        ledger, waiting = self.parts.ledger, sum((await self._waiting()).values())
        return {"model": self._model, "work": Work(jobs=await ledger.jobs_by_phase(), outbox=waiting, store=store)}

    async def _own_families(self) -> tuple[MetricFamily, ...]:
        now, phases = time.time(), await self.parts.ledger.phases()
        counts = {phase.value: 0.0 for phase in Phase} | {phase: float(count) for phase, count, _ in phases}
        ages = {phase.value: 0.0 for phase in UNFINISHED}
        ages |= {phase: max(0.0, now - since) for phase, _, since in phases if phase in ages}
        age = "Seconds since the first of the jobs in a phase entered it; 0 without one"
        kinds = {"demand": 0, "offer": 0, "withdrawal": 0, "result": 0} | await self._waiting()
        unsettled = "Messages that are sent again until their effect is on the chain"
        recorded, traffic = self._executor.recordings.recorders.statistics(), self.parts.exchange.statistics()
        lies = sum(traffic.corrupt_blocks.values())
        return (
            by_label("aira_jobs", "gauge", "Jobs in the ledger, by phase", "phase", counts),
            by_label("aira_job_standing_seconds", "gauge", age, "phase", ages),
            by_label("aira_outbox_messages", "gauge", unsettled, "kind", kinds),
            counter("aira_recorded_messages_total", "Messages written to recordings", recorded.recorded),
            counter("aira_recording_lost_messages_total", "Messages that could not be recorded", recorded.lost),
            gauge("aira_recording_lag_seconds", "Seconds that a message has waited to be written", recorded.lag),
            counter("aira_content_fetched_bytes_total", "Bytes of content fetched from others", traffic.fetched_bytes),
            counter("aira_content_served_blocks_total", "Blocks of content served to others", traffic.served),
            counter("aira_content_lies_total", "Blocks of content that did not match their CID", lies),
        )

    async def _waiting(self) -> dict[str, int]:
        """The messages in the outbox, by kind."""
        return await self.parts.ledger.waiting_by_kind(head=self.parts.chain_head.contract_block)

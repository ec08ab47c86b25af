"""What happens on the chain, and what it means for the agent: its trade, its jobs, its token events.

`ChainListener` reads the chain block by block and saves its position in the ledger, so it misses nothing while the
agent is down. Handling is idempotent: a block that was handled in part is handled again. The methods named `…_reverted`
undo what a reorganisation reverts.
"""

from __future__ import annotations

import logging
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING

from msgspec.structs import replace

from mesh.agent.contract import Outcome
from mesh.agent.token_events import TokenEvents
from mesh.chain import (
    Approval,
    Finalized,
    History,
    NewLiability,
    NoContracts,
    NotALiability,
    Reorganisation,
    Transfer,
)
from mesh.log_context import liability_context, log_event, with_liability_context
from mesh.retry import Backoff
from mesh.work.outbox import result_identity
from mesh.work.phases import TO_BE_DONE, Phase, advance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.agent.components import AgentComponents
    from mesh.agent.trade import Trader
    from mesh.chain import ChainEvent
    from mesh.work.executor import Executor, OnPhase
    from mesh.work.ledger import JobRecord
    from schemas import Liability

log = logging.getLogger(__name__)


class ChainListener:
    """Reads the chain for one agent, from the position in its ledger on."""

    def __init__(self, parts: AgentComponents, trader: Trader, executor: Executor, *, on_phase: OnPhase) -> None:
        self._parts = parts
        self._chain = parts.chain
        self._ledger = parts.ledger
        self._account = parts.signer.address
        self._trader = trader
        self._executor = executor
        self._on_phase = on_phase
        self.token_events = TokenEvents(parts.channel.put, self._account)

    async def run(self) -> None:
        """Read until cancelled, through outages of the node. Raises `ChainWentBack` and `UnknownName`."""
        settings, chain, outages = self._parts.settings, self._chain, self._parts.outages
        find_token = partial(chain.names.address, settings.erc20_token)
        token = await chain.retrying(find_token, outages=outages) if settings.erc20_token else ""
        backoff = Backoff(chain.node.timing.outage_retry)
        while True:
            try:
                await self._follow(token, backoff)
            except NoContracts as error:
                # The event's contract is missing: its block was replaced, or another node is behind.
                log.info("the block is read again: %s", error, extra=log_event("block-read-again", code=error.code))
                await backoff.wait()

    async def _follow(self, token: str, backoff: Backoff) -> None:
        """Read on from the position in the ledger."""
        cursor, history = await self._position()
        following = self._chain.follow(
            cursor,
            history=history,
            token=token,
            parties=[self._account],
            choose=self._choose,
            outages=self._parts.outages,
        )
        async with aclosing(following) as blocks:
            async for block in blocks:
                if isinstance(block, Reorganisation):
                    facts = log_event("chain-reorganised", block=block.block_number, events=len(block.reverted_events))
                    log.warning("the chain replaced all blocks after %d", block.block_number, extra=facts)
                    for event in block.reverted_events:
                        await self.revert(event)
                    self._trader.reorganised()
                if block.events:
                    # If it is handled only in part, and replaced before the agent is back, it is reverted like others.
                    await self._ledger.set_cursor(block.block_number - 1, history=history.encode())
                for event in block.events:
                    await self.handle(event)
                await self._ledger.set_cursor(block.block_number, history=history.encode())
                await self.new_head(block.block_number)
                backoff.reset()

    async def finalize_ended(self) -> None:
        """Finalize the jobs that ended while the agent was away, before any of them is played to the device again."""
        for job in await self._ledger.jobs(TO_BE_DONE):
            read = partial(self._chain.liabilities.get, job.liability.address)
            try:
                now = await self._chain.retrying(read, outages=self._parts.outages)
            except (NotALiability, NoContracts):  # reverted, which the listener will find
                continue
            if now.is_finalized:
                await self.finalized(now.address, success=now.is_success, result=now.result)

    async def _position(self) -> tuple[int, History]:
        """The first block to read, and the history of those before it."""
        depth = self._chain.node.timing.reorg_depth
        last, encoded = await self._ledger.cursor()
        assert last is not None, "the agent's components set it"
        history = History.decode(encoded) if encoded else History(depth)
        history.depth = depth  # the setting may have changed
        self._parts.chain_head.begin_after(last)
        return last + 1, history

    async def _choose(self, created: Sequence[str], ended: Sequence[str]) -> set[str]:
        """Of the liabilities that were created or ended in some blocks, those that may concern this agent."""
        chosen = set(created)
        if len(created) > 1:  # one call for all, because most are between others
            parties = await self._chain.liabilities.parties(created)
            chosen = {one for one, named in zip(created, parties, strict=True) if self._account in named}
        if ended:
            held = await self._ledger.holds([*ended, *map(result_identity, ended)])
            watched = self._trader.contracts
            chosen |= {one for one in ended if one in held or result_identity(one) in held or one in watched}
        return chosen

    async def handle(self, event: ChainEvent) -> None:
        """Act on an event of the chain."""
        match event:
            case NewLiability():
                with liability_context(event.liability):
                    await self._read_new(event.liability)
            case Finalized():
                await self.finalized(event.liability, success=event.success, result=event.result)
            case Transfer() | Approval():
                self.token_events.publish(event)

    async def revert(self, event: ChainEvent) -> None:
        """Undo an event that a reorganisation has reverted."""
        match event:
            case NewLiability():
                await self.liability_reverted(event.liability)
            case Finalized():
                await self.finalization_reverted(event.liability)
            case Transfer() | Approval():
                self.token_events.revert(event)

    async def _read_new(self, address: str) -> None:
        """Read a new liability and, if it names this account, its orders."""
        read = partial(self._chain.liabilities.get_with_orders, address)
        try:
            liability, orders = await self._chain.retrying(read, outages=self._parts.outages)
        except NotALiability:
            facts = log_event("liability-gone", liability=address)
            log.warning("the liability was reverted before it was read", extra=facts)
            return
        if self._account in (liability.promisor, liability.promisee):
            await self.new_liability(liability, demand_hash=orders[0], offer_hash=orders[1])

    @with_liability_context
    async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was created that names this account: as promisee, as promisor, or as both."""
        await self._trader.matched(liability, demand_hash=demand_hash, offer_hash=offer_hash)
        if liability.promisor != self._account:
            return
        if not self._parts.settings.enable_executor:
            if not liability.is_finalized:  # for the account's next run that does jobs, or one beside this
                await self._ledger.add_job(liability)
            return
        await self._executor.wait_until_open()
        if liability.is_finalized:
            if await self._ledger.bring_back(liability.address):
                await self.finalized(liability.address, success=liability.is_success, result=liability.result)
            return
        address, is_known = liability.address, not await self._ledger.add_job(liability)
        job = await self._ledger.job(address)
        # Another program of the account may have added it, and left it to this one.
        if job is None or (is_known and (job.phase is not Phase.INCOMING or address in self._executor.preparing)):
            return
        if job.result is not None:
            await self._owe_result(job)
            return
        facts = log_event("job-accepted", model=liability.model, objective=liability.objective, cost=liability.cost)
        log.info("new job, model %s, objective %s", liability.model, liability.objective, extra=facts)
        await self._on_phase(Phase.INCOMING, liability)
        self._executor.prepare(liability)

    @with_liability_context
    async def liability_reverted(self, address: str) -> None:
        """A reorganisation reverted a contract: its job is set aside, and our order is sent again."""
        async with self._executor.halted(address) as job:
            if job is not None:
                await self._ledger.set_aside(address)
                await self._parts.outbox.settle(result_identity(address))
                log.warning("the liability was reverted; its job waits", extra=log_event("job-set-aside"))
        await self._trader.liability_reverted(address)

    @with_liability_context
    async def finalized(self, address: str, *, success: bool, result: str) -> None:
        """A contract has paid (`success`) or refunded. `result` is the CID of its recording."""
        async with self._executor.halted(address) as job:
            # In this order: after a crash in between, the block is handled again and finds the job unfinished.
            await self._parts.outbox.settle(result_identity(address))  # also one that was signed by request
            if job is not None and job.phase is not Phase.FINALIZED:
                await self._ledger.set_phase(address, advance(address, job.phase, Phase.FINALIZED))
        if job is not None and job.phase is not Phase.FINALIZED:
            facts = log_event("job-finalized", success=success)
            log.info("finalized, %s", "paid" if success else "refunded", extra=facts)
            ended = replace(job.liability, is_finalized=True, is_success=success, result=job.result or "")
            await self._on_phase(Phase.FINALIZED, ended)
        self._trader.contracts.finalized(address, Outcome(success=success, result=result))

    @with_liability_context
    async def finalization_reverted(self, address: str) -> None:
        """A reorganisation reverted the end of a contract: the Result of its job, if it has one, is sent again."""
        async with self._executor.halted(address) as job:
            if job is not None and job.result is not None:
                log.warning("the finalization was reverted", extra=log_event("finalization-reverted"))
                await self._owe_result(job)

    async def new_head(self, block: int) -> None:
        """All of `block` has been handled. After a reorganisation it may be lower than before."""
        self._parts.chain_head.advance_to(block)
        await self._parts.outbox.expire(block)
        await self._trader.new_head(block)

    async def _owe_result(self, job: JobRecord) -> None:
        """Send the Result of a complete job again."""
        assert job.result is not None
        address, success = job.liability.address, bool(job.success)
        await self._executor.owe_result(address, success=success, result=job.result, note=job.note)
        await self._parts.outbox.send_new()

"""What the chain says of an agent's contracts, brought to its jobs: new ones, ended ones, and what it takes back."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import msgspec

from mesh.telemetry.context import log_event
from mesh.work.lifecycle import Phase, advance
from mesh.work.outbox import result_identity

if TYPE_CHECKING:
    from mesh.work.executor import Executor
    from mesh.work.lifecycle import PhaseListener
    from mesh.work.workshop import Workshop
    from schemas import Liability

log = logging.getLogger(__name__)


class LiabilityEvents:
    """The jobs of one agent as the chain has them. Each method bears to be told the same again."""

    def __init__(self, workshop: Workshop, executor: Executor, *, witness: PhaseListener) -> None:
        self._shop = workshop
        self._executor = executor
        self._witness = witness

    async def accept(self, liability: Liability) -> None:
        """A liability names us: write it down and prepare it. Known and ended ones are left as they are.

        One that the chain took back and made again is gone on with.
        """
        address = liability.address
        await self._executor.opened()
        if liability.is_finalized or not await self._shop.ledger.add_job(liability):
            return
        job = await self._shop.ledger.job(address)
        assert job is not None
        if job.result is not None:
            await self._shop.owe_result(address, success=bool(job.success), result=job.result, note=job.note)
            await self._shop.outbox.send()
            return
        known = log_event("unnamed", model=liability.model, objective=liability.objective, cost=liability.cost)
        log.info("incoming, model %s, objective %s", liability.model, liability.objective, extra=known)
        await self._witness(Phase.INCOMING, liability)
        self._executor.prepare(liability)

    async def finalized(self, address: str, *, success: bool) -> None:
        """The liability at `address` has paid or refunded; nothing more is owed. Unknown ones are ignored."""
        async with self._executor.halted(address) as job:
            if job is None or job.phase is Phase.FINALIZED:
                return
            # In this order: after a crash between the two, the same block is handled again and finds the job unended.
            await self._shop.outbox.settle(result_identity(address))
            await self._shop.ledger.set_phase(address, advance(address, job.phase, Phase.FINALIZED))
        log.info("finalized, %s", "paid" if success else "refunded")
        ended = msgspec.structs.replace(job.liability, is_finalized=True, is_success=success, result=job.result or "")
        await self._witness(Phase.FINALIZED, ended)

    async def taken_back(self, address: str) -> None:
        """After a reorganisation the liability at `address` has not ended: its Result is owed again.

        One that ended without a Result of ours is left alone: whoever refunded it will do so again.
        """
        async with self._executor.halted(address) as job:
            if job is None or job.phase is not Phase.FINALIZED or job.result is None:
                return
            await self._shop.owe_result(address, success=bool(job.success), result=job.result, note=job.note)
        log.warning("the chain took back its end; the Result is sent again")
        await self._shop.outbox.send()

    async def unmade(self, address: str) -> None:
        """After a reorganisation there is no liability at `address`: its job rests until it is made again."""
        async with self._executor.halted(address) as job:
            if job is None:
                return
            await self._shop.ledger.set_aside(address)
            await self._shop.outbox.settle(result_identity(address))
        log.warning("the chain took the contract back; its job rests")

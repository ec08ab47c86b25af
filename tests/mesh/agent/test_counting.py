"""The counts of the ledger that an agent reports in its status."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.agent.ledger import Ledger, Outgoing, Phase
from tests.support.agent.samples import liability
from tests.support.orders import demand

if TYPE_CHECKING:
    from pathlib import Path


async def test_jobs_are_counted_by_phase_and_those_set_aside_are_none(tmp_path: Path) -> None:
    async with Ledger(tmp_path / "ledger.sqlite") as ledger:
        assert await ledger.jobs_by_phase() == {}
        await ledger.add_job(liability())
        assert await ledger.jobs_by_phase() == {"incoming": 1}
        await ledger.set_phase(liability().address, Phase.FINALIZED)
        assert await ledger.jobs_by_phase() == {"finalized": 1}
        await ledger.set_aside(liability().address)
        assert await ledger.jobs_by_phase() == {}


async def test_messages_wait_until_they_are_settled(tmp_path: Path) -> None:
    async with Ledger(tmp_path / "ledger.sqlite") as ledger:
        orders = [Outgoing.of(demand()) for _ in range(2)]
        for order in orders:
            await ledger.post(order)
        assert sum((await ledger.waiting_by_kind(head=0)).values()) == 2
        await ledger.settle(orders[0].identity)
        assert sum((await ledger.waiting_by_kind(head=0)).values()) == 1

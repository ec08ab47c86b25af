"""An operator blocks a signer while a provider runs: what the provider holds of it goes, too."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.base.fresh_file import Blocklist
from mesh.market import order_id
from schemas import verify_message
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.provider.local_market import LocalMarket


async def test_the_orders_of_a_blocked_signer_leave_the_book(local: LocalMarket, tmp_path: Path) -> None:
    path = tmp_path / "blocked.txt"
    path.touch()
    async with local.provider(blocked=Blocklist(path)) as provider:
        demands = [local.demand(cost=0), local.demand(cost=0), local.demand("rival", cost=0)]
        local.publish(*demands)
        await until(lambda: len(provider.book) == 3)
        path.write_text(local.address("person"))

        await until(lambda: len(provider.book) == 1)
        assert order_id(verify_message(demands[2])) in provider.book
        assert provider.drops.totals()["blocked"] == 2
        assert provider.drops.heaviest("blocked") == [(local.address("person"), 2)]

        path.write_text("")

        async def is_back() -> bool:
            local.publish(demands[0])
            await asyncio.sleep(0.1)
            return len(provider.book) == 2

        await until_found(is_back)


async def test_no_contract_is_made_with_a_signer_that_is_blocked_before_its_turn(
    local: LocalMarket, tmp_path: Path
) -> None:
    path = tmp_path / "blocked.txt"
    path.touch()
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with local.provider("rival", blocked=Blocklist(path)) as rival:
        demand, offer = local.demand(), local.offer()
        local.publish(demand, offer)
        await until(lambda: len(rival.book) == 0 and rival.queue.waiting == 1 and rival.ledger.turnover().matches == 1)
        path.write_text(local.address("person"))
        await until(lambda: local.address("person") in rival.settlement.blocked)

        async with local.chain_of("provider") as chain:  # gives the turn to the rival
            await chain.liabilities.create(local.lighthouse, local.demand(cost=0), local.offer(cost=0))
        await until(lambda: list(rival.book.orders()) == [verify_message(offer)])
        assert await local.liabilities_of(demand) == []
        assert rival.drops.totals()["blocked"] == 1
        assert local.rejections == []

"""A provider honours withdrawals: before a match, before its transaction, after a restart, and of others' knowledge."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

from mesh.market import order_id
from mesh.market.store import WithdrawalLimits, withdrawn_id
from mesh.settings.chains import ANY
from schemas import Withdrawal, verify_message
from schemas.signing import Refusal
from tests.support.provider.held_node import HeldNode
from tests.support.provider.observation import until_read, works_on
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from tests.support.provider.local_market import LocalMarket


async def test_a_withdrawn_order_leaves_the_book_and_is_refused(local: LocalMarket) -> None:
    async with local.provider() as provider:
        local.publish(demand := local.demand())
        await until(lambda: len(provider.book) == 1)
        local.publish(local.withdrawal(demand))

        honoured = await local.rejection_of(demand)
        assert (honoured.reason, honoured.provider) == ("withdrawn", provider.address)
        assert len(provider.book) == 0
        local.publish(offer := local.offer())
        await until(lambda: order_id(verify_message(offer)) in provider.book)
        assert await local.liabilities_of(demand) == []
        assert provider.earnings().rejected == {}


async def test_a_withdrawal_that_can_not_be_kept_takes_its_order_out_of_the_book_all_the_same(
    local: LocalMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that loses many offers withdraws more than a provider keeps of one account."""
    async with local.provider() as provider:
        monkeypatch.setattr(provider.withdrawals, "_limits", WithdrawalLimits(of_signer=0))
        local.publish(demand := local.demand())
        await until(lambda: len(provider.book) == 1)
        local.publish(local.withdrawal(demand))
        await until(lambda: len(provider.book) == 0)
        assert len(provider.withdrawals) == 0


async def test_an_order_that_arrives_after_its_withdrawal_is_refused(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand = local.demand()
        local.publish(local.withdrawal(demand))
        await local.rejection_of(demand)
        local.publish(demand, local.offer())

        await until(lambda: provider.earnings().rejected == {"withdrawn": 1})
        await until(lambda: len(provider.book) == 1)
        assert await local.liabilities_of(demand) == []


async def test_a_withdrawal_by_another_account_changes_nothing(local: LocalMarket) -> None:
    async with local.provider() as provider:
        local.publish(demand := local.demand())
        await until(lambda: len(provider.book) == 1)
        local.publish(stranger := local.withdrawal(demand, "rival"))
        await until(lambda: withdrawn_id(verify_message(stranger)) in provider.withdrawals)

        local.publish(local.offer())
        await local.liability_of(demand)


async def test_a_match_is_not_made_if_an_order_is_withdrawn_before_its_turn(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=1000, provider=1, rival=1)
    async with local.provider("rival") as rival:
        demand, offer = local.demand(), local.offer()
        local.publish(demand, offer)
        await until(lambda: len(rival.book) == 0 and rival.queue.waiting == 1 and rival.ledger.turnover().matches == 1)
        local.publish(withdrawal := local.withdrawal(demand))
        await until(lambda: withdrawn_id(verify_message(withdrawal)) in rival.withdrawals)
        assert local.rejections == []  # a transaction may be on its way

        async with local.chain_of("provider") as chain:  # gives the turn to the rival
            await chain.liabilities.create(local.lighthouse, local.demand(cost=0), local.offer(cost=0))
        assert (await local.rejection_of(demand)).reason == "withdrawn"
        await until(lambda: list(rival.book.orders()) == [verify_message(offer)])
        assert await local.liabilities_of(demand) == []


async def test_a_transaction_that_was_sent_is_not_stopped(local: LocalMarket) -> None:
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        demand = local.demand()
        with node.back("eth_getTransactionReceipt"):
            local.publish(demand, local.offer())
            await local.liability_of(demand)
            local.publish(withdrawal := local.withdrawal(demand))
            await until(lambda: withdrawn_id(verify_message(withdrawal)) in provider.withdrawals)
        await until(lambda: provider.earnings().created == 1)
        assert local.rejections == []


async def test_withdrawals_survive_a_restart(local: LocalMarket, tmp_path: Path) -> None:
    path, demand = tmp_path / "withdrawals.sqlite", local.demand()
    async with local.provider(store=path):
        local.publish(local.withdrawal(demand))
        await local.rejection_of(demand)

    async with local.provider(store=path) as provider:
        local.publish(demand, local.offer())
        await until(lambda: provider.earnings().rejected == {"withdrawn": 1})
        assert await local.liabilities_of(demand) == []


async def test_a_flood_of_strangers_withdrawals_makes_no_other_forgotten(local: LocalMarket) -> None:
    async with local.provider() as provider:
        provider.withdrawals._limits = WithdrawalLimits(kept=4)
        demand = local.demand()
        provider.book.known.add(verify_message(demand).signer)
        local.publish(demand)
        await until(lambda: provider.book.stays(order_id(verify_message(demand))))
        local.publish(local.withdrawal(demand))
        assert (await local.rejection_of(demand)).reason == "withdrawn"

        for later in range(8):  # none is before those that are known, and so none takes their place
            local.publish(local.withdrawal(local.demand("rival", deadline=demand.deadline - 8 + later), "rival"))
        await until(lambda: len(provider.withdrawals) == 4)
        await until(lambda: provider.drops.totals().get("withdrawals", 0) > 0)
        assert provider.settlement.add(verify_message(demand)) is Refusal.WITHDRAWN


async def test_a_withdrawal_that_is_not_on_the_disk_is_not_promised(
    local: LocalMarket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, "the disk is broken")

    demand = local.demand()
    async with local.provider(store=tmp_path / "store.sqlite") as provider:
        monkeypatch.setattr(os, "fsync", fail)
        local.publish(withdrawal := local.withdrawal(demand))
        await until(lambda: withdrawn_id(verify_message(withdrawal)) in provider.withdrawals)
        assert provider.settlement.add(verify_message(demand)) is Refusal.WITHDRAWN
        local.publish(known := local.demand(cost=2**200))
        await local.rejection_of(known)
        assert local.rejected_makers.keys() == {verify_message(known).hash.hex()}


async def test_a_provider_that_starts_later_learns_withdrawals_from_others(local: LocalMarket) -> None:
    async with local.provider():
        demand = local.demand()
        local.publish(withdrawal := local.withdrawal(demand))
        await local.rejection_of(demand)

        async with local.provider("rival") as second:
            await until(lambda: list(second.withdrawals) == [verify_message(withdrawal)])
        async with local.channel.subscribe(Withdrawal) as withdrawals:
            await withdrawals.recall()
            assert (await anext(withdrawals)).message == withdrawal


async def test_withdrawals_are_known_until_no_reorganisation_reaches_their_deadline(
    local: LocalMarket, tmp_path: Path
) -> None:
    path, demand = tmp_path / "withdrawals.sqlite", local.demand(deadline=await local.chain.block_number() + 3)
    async with local.provider(store=path) as provider:
        local.publish(local.withdrawal(demand))
        await local.rejection_of(demand)
        await local.mine(3)
        await until_read(local, provider)
        assert len(provider.withdrawals) == 1

    async with local.provider(store=path) as provider:  # it reads the blocks again that may be replaced
        assert provider.settlement.add(verify_message(demand)) is Refusal.WITHDRAWN
        assert provider.earnings().rejected == {"withdrawn": 1}
        await local.mine(ANY.reorg_depth)
        await until_read(local, provider)
        assert len(provider.withdrawals) == 0
        assert await works_on(local, provider)

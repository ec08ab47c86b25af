"""Orders of generation 5 that were signed again: a provider settles the newest version, and one of them only."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Timing
from mesh.market import order_id
from mesh.market._orders import OrderVersions
from mesh.market.store import MarketStore, withdrawn_id
from schemas import Demand, Withdrawal, verify_message
from schemas.signing import Refusal
from tests.support.provider.held_node import HeldNode
from tests.support.provider.observation import until_read
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.market.provider import Provider
    from tests.support.provider.local_market import LocalMarket

DEPTH = Timing().reorg_depth


async def versions_of(local: LocalMarket, count: int, **terms: Any) -> list[Demand]:
    """One demand of the person's, signed with the next nonces."""
    person = local.address("person")
    nonce = await local.chain.liabilities.next_nonce(person)
    return [local.demand(sender=person, nonce=nonce + later, **terms) for later in range(count)]


async def test_the_newest_version_takes_the_place_of_the_others(local: LocalMarket) -> None:
    older, newer = await versions_of(local, 2)
    async with local.provider() as provider:
        local.publish(older)
        await until(lambda: len(provider.book) == 1)
        local.publish(newer)
        await until(lambda: list(provider.book.orders()) == [verify_message(newer)])
        assert provider.settlement.add(verify_message(older)) is Refusal.REPLACED
        assert (await local.rejection_of(older)).reason == "replaced"
        assert list(provider.book.orders()) == [verify_message(newer)]


async def test_orders_with_other_terms_or_of_others_are_no_versions(local: LocalMarket) -> None:
    nonce = 7
    terms: dict[str, Any] = {"sender": local.address("person")}
    first = verify_message(local.demand(nonce=nonce, **terms))
    others = [
        verify_message(local.demand(nonce=nonce + 1, **terms | {"cost": 1})),
        verify_message(local.demand(nonce=nonce + 1, **terms | {"deadline": first.message.deadline - 1})),
        verify_message(local.demand("robot", nonce=nonce + 1, sender=local.address("robot"))),
        verify_message(local.demand()),
    ]
    versions = OrderVersions(DEPTH)
    assert [versions.note(order) for order in (first, *others)] == [None] * 5
    assert not any(versions.refusal(order_id(order), head=1) for order in (first, *others))


async def test_no_version_is_settled_once_another_has_become_a_contract(local: LocalMarket) -> None:
    """Until a reorganisation reverts that contract."""
    older, newer = await versions_of(local, 2)
    robot = local.address("robot")
    offer = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
    async with local.provider() as provider:
        local.publish(older)
        await until(lambda: len(provider.book) == 1)
        local.publish(newer)
        await until(lambda: list(provider.book.orders()) == [verify_message(newer)])
        before = await local.request("evm_snapshot")
        async with local.chain_of("provider") as chain:
            await chain.liabilities.create(local.lighthouse, older, offer)
        await until_read(local, provider)
        assert len(provider.book) == 0
        assert provider.settlement.add(verify_message(newer)) is Refusal.REPLACED
        await local.request("evm_revert", before)
        await local.mine(3)
        await until(lambda: provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED)
        await local.mine(DEPTH)
        await until(lambda: provider.settlement.add(verify_message(newer)) is Refusal.DUPLICATE)
        assert list(provider.book.orders()) == [verify_message(newer)]


async def fail_when_mined(
    local: LocalMarket, provider: Provider, node: HeldNode, demand: Demand, *meanwhile: Withdrawal
) -> None:
    """Have the provider's transaction of a demand mined after its offer was used up, and publish messages meanwhile."""
    robot = local.address("robot")
    sender: dict[str, Any] = {}
    if demand.generation == 5:
        sender = {"sender": robot, "nonce": await local.chain.liabilities.next_nonce(robot)}
    offer = local.offer(**sender)
    with node.back("eth_sendRawTransaction"):
        local.publish(demand, offer)
        await until(lambda: node.waiting["eth_sendRawTransaction"])
        async with local.chain_of("robot") as chain:
            await chain.liabilities.withdraw(offer)
        local.publish(*meanwhile)
        await until(lambda: len(provider.withdrawals) == len(meanwhile))
    await until(lambda: provider.earnings().gas_used, what="it has failed when it was mined")


async def test_no_other_version_is_settled_while_a_transaction_is_on_its_way(local: LocalMarket) -> None:
    older, newer = await versions_of(local, 2)
    robot = local.address("robot")
    offer = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        with node.back("eth_sendRawTransaction"):
            local.publish(older, offer)
            await until(lambda: node.waiting["eth_sendRawTransaction"])
            assert provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED
        await local.liability_of(older)
        await until_read(local, provider)
        assert provider.settlement.add(verify_message(newer)) is Refusal.REPLACED


async def test_a_version_whose_maker_can_not_pay_replaces_an_older_one(local: LocalMarket) -> None:
    older, newer = map(verify_message, await versions_of(local, 2))
    async with local.provider() as provider:
        assert provider.settlement.add(older) is None
        provider.settlement.set_aside(newer, "ERC20InsufficientAllowance")
        assert provider.settlement.add(older) is Refusal.REPLACED


async def test_no_other_version_is_settled_until_a_failed_transaction_is_deep(local: LocalMarket) -> None:
    """A reorganisation might let the transaction succeed."""
    older, newer = await versions_of(local, 2)
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        await fail_when_mined(local, provider, node, older)
        await until(lambda: list(provider.book.orders()) == [verify_message(older)], what="the same version is")
        assert provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED
        assert (await local.rejection_of(newer)).reason == "undecided"
        await local.mine(DEPTH - 1)
        await until_read(local, provider)
        assert provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED
        await local.mine(1)
        await until_read(local, provider)
        assert provider.settlement.add(verify_message(newer)) is None
        assert list(provider.book.orders()) == [verify_message(newer)]


async def test_no_other_version_is_settled_before_the_nonce_of_a_vanished_transaction_is_used(
    local: LocalMarket,
) -> None:
    """However long that takes: an earlier transaction of the account may be stuck."""
    older, newer = await versions_of(local, 2)
    before = await local.request("evm_snapshot")
    async with local.chain_of("provider") as chain, HeldNode(local.node) as node:
        await chain.tokens.approve(local.address("robot"), 1)
        async with local.provider(endpoint=node) as provider:
            await fail_when_mined(local, provider, node, older)
            await local.request("evm_revert", before)
            await local.mine(3)
            await until_read(local, provider)
            await local.mine(2 * DEPTH)
            await until_read(local, provider)
            assert provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED
            await chain.tokens.approve(local.address("robot"), 2)
            for _ in range(2):  # the first time it may read all of them at once
                await local.mine(DEPTH)
                await until_read(local, provider)
            await until(lambda: provider.settlement.add(verify_message(newer)) is not Refusal.UNDECIDED)
            assert list(provider.book.orders()) == [verify_message(newer)]


@pytest.mark.sample("generation")
@pytest.mark.parametrize("generation", [3, 5])
@pytest.mark.parametrize("comes", ["before it failed", "after it failed"])
async def test_no_withdrawal_is_honoured_until_a_failed_transaction_is_deep(
    local: LocalMarket, generation: int, comes: str
) -> None:
    order = local.demand() if generation == 3 else (await versions_of(local, 1))[0]
    withdrawal = local.withdrawal(order)
    async with HeldNode(local.node) as node, local.provider(endpoint=node) as provider:
        if comes == "before it failed":
            await fail_when_mined(local, provider, node, order, withdrawal)
        else:
            await fail_when_mined(local, provider, node, order)
            local.publish(withdrawal)
            await until(lambda: withdrawn_id(verify_message(withdrawal)) in provider.withdrawals)
        assert provider.settlement.add(verify_message(order)) is Refusal.WITHDRAWN
        await local.mine(DEPTH)
        await until_read(local, provider)
        async with asyncio.timeout(60):
            while "withdrawn" not in reasons(local):
                local.publish(withdrawal)
                await asyncio.sleep(0.05)
        assert reasons(local).count("withdrawn") == 1


def reasons(local: LocalMarket) -> list[str]:
    """Why messages were rejected so far."""
    return [rejection.reason for rejection in local.rejections]


async def test_no_withdrawal_is_honoured_while_a_reverted_contract_may_come_back(local: LocalMarket) -> None:
    demand, offer = local.demand(), local.offer()
    async with local.provider() as provider:
        before = await local.request("evm_snapshot")
        async with local.chain_of("provider") as chain:
            await chain.liabilities.create(local.lighthouse, demand, offer)
        await until_read(local, provider)
        await local.request("evm_revert", before)
        await local.mine(3)
        await until_read(local, provider)
        withdrawal = verify_message(local.withdrawal(demand))
        await until(lambda: provider.settlement.add(verify_message(demand)) is Refusal.DUPLICATE)
        provider.settlement.withdraw(withdrawal)
        assert provider.settlement.add(verify_message(demand)) is Refusal.WITHDRAWN
        await local.mine(DEPTH)
        await until_read(local, provider)
        provider.settlement.withdraw(withdrawal)
        await local.rejection_of(demand)
        assert reasons(local) == ["withdrawn"]


async def test_a_restarted_provider_knows_the_orders_of_earlier_transactions(
    local: LocalMarket, tmp_path: Path
) -> None:
    older, newer = await versions_of(local, 2)
    async with HeldNode(local.node) as node:
        async with local.provider(endpoint=node, store=tmp_path / "sent") as provider:
            await fail_when_mined(local, provider, node, older)
        async with local.provider(endpoint=node, store=tmp_path / "sent") as provider:
            assert provider.settlement.add(verify_message(newer)) is Refusal.UNDECIDED
            await until_read(local, provider)  # the blocks that confirm the failure come after the first that it reads
            await local.mine(DEPTH)
            await until_read(local, provider)
            assert provider.settlement.add(verify_message(newer)) is None
        with MarketStore(tmp_path / "sent") as store:
            assert store.sent_orders() == []


async def test_a_restarted_provider_honours_no_withdrawal_of_what_may_be_mined(
    local: LocalMarket, tmp_path: Path
) -> None:
    demand = local.demand()
    async with HeldNode(local.node) as node:
        async with local.provider(endpoint=node, store=tmp_path / "sent") as provider:
            await fail_when_mined(local, provider, node, demand)
        async with local.provider(endpoint=node, store=tmp_path / "sent") as provider:
            local.publish(withdrawal := local.withdrawal(demand))
            await until(lambda: withdrawn_id(verify_message(withdrawal)) in provider.withdrawals)
            assert provider.settlement.add(verify_message(demand)) is Refusal.WITHDRAWN
            assert "withdrawn" not in reasons(local)
            await local.mine(DEPTH + 1)
            await until_read(local, provider)
            provider.settlement.withdraw(verify_message(withdrawal))
            await local.rejection_of(demand)
            assert reasons(local).count("withdrawn") == 1


async def test_the_end_of_a_match_that_was_not_sent_ends_no_other(local: LocalMarket) -> None:
    older, newer = map(verify_message, await versions_of(local, 2))
    versions = OrderVersions(DEPTH)
    versions.note(older)
    versions.sending([older])
    versions.note(newer)
    versions.ended([newer], head=10)
    assert versions.refusal(order_id(newer), head=99) is Refusal.UNDECIDED
    versions.ended([older], head=10)
    assert versions.refusal(order_id(newer), head=99) is None


async def test_no_version_is_settled_while_transactions_with_two_may_succeed(local: LocalMarket) -> None:
    versions = OrderVersions(DEPTH)
    older, newer = map(verify_message, await versions_of(local, 2))
    for order, block in ((older, 10), (newer, 12)):
        versions.note(order)
        versions.failed([order], nonce=3, block=block)
    assert versions.refusal(order_id(newer), head=11 + DEPTH) is Refusal.UNDECIDED
    assert versions.refusal(order_id(newer), head=12 + DEPTH) is None


async def test_a_failed_transaction_in_a_replaced_block_is_mined_again_later(local: LocalMarket) -> None:
    older, newer = map(verify_message, await versions_of(local, 2))
    versions = OrderVersions(DEPTH)
    versions.note(older)
    versions.failed([older], nonce=3, block=10)
    versions.note(newer)
    versions.reorganised(10, head=14)
    assert versions.refusal(order_id(newer), head=10 + DEPTH) is None
    versions.reorganised(9, head=14)
    assert versions.refusal(order_id(newer), head=99) is Refusal.UNDECIDED
    versions.counted(4, 4, head=15)
    assert versions.refusal(order_id(newer), head=14 + DEPTH) is Refusal.UNDECIDED
    assert versions.refusal(order_id(newer), head=15 + DEPTH) is None


@pytest.mark.parametrize(
    ("mined", "pending", "is_open"),
    [
        pytest.param(2, 5, True, id="the transaction waits"),
        pytest.param(2, 2, True, id="an earlier one was lost"),
        pytest.param(3, 3, False, id="it was lost"),
        pytest.param(3, None, True, id="it may be sent again"),
        pytest.param(4, 4, False, id="its nonce was used"),
    ],
)
async def test_a_transaction_is_decided_by_the_nonces_of_its_account(
    local: LocalMarket, mined: int, pending: int | None, is_open: bool
) -> None:
    older, newer = map(verify_message, await versions_of(local, 2))
    versions = OrderVersions(DEPTH)
    versions.note(older)
    versions.failed([older], nonce=3, block=10)
    versions.note(newer)
    assert versions.need_count()
    versions.counted(mined, pending, head=10 + DEPTH)
    assert versions.need_count() is is_open
    assert (versions.refusal(order_id(newer), head=10 + DEPTH) is Refusal.UNDECIDED) is is_open
    versions.counted(4, 4, head=11 + DEPTH)
    assert versions.refusal(order_id(newer), head=11 + 2 * DEPTH) is None


async def test_a_transaction_mined_in_a_block_that_was_not_looked_at_is_decided_once_that_is_deep(
    local: LocalMarket,
) -> None:
    """The chain is followed from block to block with events, and from far back after a restart."""
    older, newer = map(verify_message, await versions_of(local, 2))
    versions = OrderVersions(DEPTH)
    versions.note(older)
    left = versions.sending([older])
    versions = OrderVersions(DEPTH)
    versions.restore(left, nonce=3, head=20)
    versions.note(newer)
    versions.counted(3, None, head=20 - DEPTH)
    versions.counted(4, 4, head=17)
    versions.counted(4, 4, head=20)
    assert versions.is_undecided(order_id(older), head=16 + DEPTH)
    assert not versions.is_undecided(order_id(older), head=17 + DEPTH)
    versions.counted(3, 3 + 1, head=25)  # a reorganisation reverted it
    versions.counted(4, 4, head=35)  # and it was mined in a block up to this one
    versions.counted(4, 4, head=34 + DEPTH)
    assert versions.refusal(order_id(newer), head=34 + DEPTH) is Refusal.UNDECIDED
    versions.counted(4, 4, head=35 + DEPTH)
    assert versions.refusal(order_id(newer), head=35 + DEPTH) is None


async def test_a_restarted_provider_settles_no_version_of_an_order_that_was_a_contract_long_ago(
    local: LocalMarket, tmp_path: Path
) -> None:
    older, newer = await versions_of(local, 2)
    robot = local.address("robot")
    offer = local.offer(sender=robot, nonce=await local.chain.liabilities.next_nonce(robot))
    async with local.provider(store=tmp_path / "sent") as provider:
        local.publish(older, offer)
        await local.liability_of(older)
        await local.mine(DEPTH + 4)
        await until_read(local, provider)
    async with local.provider(store=tmp_path / "sent") as provider:
        await until_read(local, provider)
        assert provider.settlement.add(verify_message(newer)) is Refusal.REPLACED

"""Orders of generation 5 that were signed again: a provider settles the newest version, and one of them only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh.market import Refusal, order_id
from mesh.market.versions import OrderVersions
from schemas import Demand, verify_message
from tests.mesh.market.observation import until_read
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.mesh.market.local_market import LocalMarket


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
    versions = OrderVersions()
    assert [versions.note(order) for order in (first, *others)] == [None] * 5
    assert not any(versions.is_replaced(order_id(order)) for order in (first, *others))


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
        await until(lambda: provider.settlement.add(verify_message(newer)) is not Refusal.REPLACED)
        await until(lambda: list(provider.book.orders()) == [verify_message(newer)])

"""Orders whose makers can't pay: not matched, kept in the book, tried again when funds return."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from mesh.market import Match, OrderBook, order_id
from schemas import verify_message
from schemas.signing import Refusal
from tests.support.orders import LIGHTHOUSE, verified_demand, verified_offer
from tests.support.provider.observation import until_read
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pytest

    from schemas import Demand, Offer, Verified
    from tests.support.provider.local_market import LocalMarket


def test_an_order_that_is_set_aside_is_in_the_book_and_is_not_matched() -> None:
    book, demand = OrderBook(LIGHTHOUSE), verified_demand(deadline=10)
    assert book.set_aside(demand)
    assert not book.set_aside(demand)
    assert book.add(demand) is Refusal.DUPLICATE
    assert list(book.orders()) == [demand]
    book.add(offer := verified_offer())
    assert len(book) == 2
    assert book.remove(order_id(demand)) == demand
    assert book.add(demand) == Match(demand, offer)
    book.set_aside(demand)
    assert book.expire(10) == [demand]
    assert not book.set_aside(demand)


async def test_a_demand_is_matched_when_its_makers_tokens_return(local: LocalMarket) -> None:
    async with local.chain_of("poor") as poor:
        await poor.tokens.approve(poor.factory, 1000)
        await poor.tokens.transfer(local.address("person"), await poor.tokens.balance())
        async with local.provider() as provider:
            demand, offer = local.demand("poor", cost=7), local.offer(cost=7)
            local.publish(demand, offer)
            assert (await local.rejection_of(demand)).reason == "ERC20InsufficientBalance"
            await until(lambda: len(provider.book) == 2)

            await local.chain.tokens.transfer(local.address("poor"), 7)
            assert (await local.liability_of(demand)).promisor == local.address("robot")
            await until_read(local, provider)
            assert len(provider.book) == 0
            await until(lambda: provider.earnings().created == 1)
        assert [one.order for one in local.rejections] == [verify_message(demand).hash.hex()]


async def test_a_demand_is_matched_when_its_allowance_is_raised(local: LocalMarket) -> None:
    await local.chain.tokens.approve(local.chain.factory, 6)
    async with local.provider() as provider:
        demand, offer = local.demand(cost=7), local.offer(cost=7)
        local.publish(demand, offer)
        assert (await local.rejection_of(demand)).reason == "ERC20InsufficientAllowance"
        await until(lambda: len(provider.book) == 2)
        gas = provider.earnings().gas_used

        await local.chain.tokens.approve(local.chain.factory, 7)
        local.publish(demand)
        await local.liability_of(demand)
        assert gas == 0


async def test_each_copy_of_an_unfunded_order_is_rejected(local: LocalMarket) -> None:
    """The first rejection may have been lost, and without one the maker would wait until the deadline."""
    await local.chain.tokens.approve(local.chain.factory, 6)
    async with local.provider() as provider:
        demand = local.demand(cost=7)

        async def is_rejected(times: int) -> bool:
            local.publish(demand)
            return len(local.rejections) >= times

        await until_found(partial(is_rejected, 3), what="three rejections")
        assert {one.reason for one in local.rejections} == {"ERC20InsufficientAllowance"}
        assert len(provider.book) == 1


async def test_a_match_is_settled_whose_maker_can_pay_in_the_latest_block(
    local: LocalMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The provider looks again before it sets an order aside, and the maker may have paid in meanwhile."""
    async with local.provider() as provider:
        shortages = provider.settlement.shortages

        async def stale(orders: Sequence[Verified[Demand | Offer]], *, fresh: bool = False) -> list[str]:
            is_late = isinstance(orders, Match) and not fresh
            return ["ERC20InsufficientAllowance", ""] if is_late else await shortages(orders, fresh=fresh)

        monkeypatch.setattr(provider.settlement, "shortages", stale)
        demand = local.demand()
        local.publish(demand, local.offer())
        await local.liability_of(demand)
        assert not local.rejections

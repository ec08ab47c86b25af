"""Contracts that don't cover the provider's gas: a few a day, or those of its customers."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

import pytest

from mesh.market import Match, order_id
from mesh.market._earnings import FreeContracts
from mesh.market.store import MarketStore
from schemas import Demand, Offer, Signer, verify_message
from schemas.rpc import PermitFeeRequest
from tests.support.clocks import SECOND, SetClock
from tests.support.orders import PERSON, ROBOT, TOKEN, verified_demand, verified_offer
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.provider.local_market import LocalMarket

COVERED = 319_000
"""A cost whose contract of generation 3 is minted for as much as its gas."""
PROVIDER = Signer(b"\x09" * 32)


def made(clock: SetClock | None = None, store: MarketStore | None = None, **options: Any) -> FreeContracts:
    return FreeContracts(PROVIDER.address, TOKEN, store=store or MarketStore(), clock=clock or SetClock(), **options)


def pair(*, fee: int = 0, person: Signer = PERSON, generation: int = 3, **terms: Any) -> Match:
    ours, theirs = ({"sender": one.address, "nonce": 1} if generation == 5 else {} for one in (person, ROBOT))
    return Match(
        verified_demand(signer=person, **terms, **ours),
        verified_offer(signer=ROBOT, lighthouse_fee=fee, **terms, **theirs),
    )


@pytest.mark.parametrize(
    ("lacking", "terms"),
    [
        (268_000, {"cost": 0}),
        (224_000, {"cost": 0, "generation": 5}),
        (0, {"cost": COVERED}),
        (1, {"cost": COVERED - 1}),
        (0, {"cost": 275_000, "generation": 5}),
        (COVERED, {"cost": 10 * COVERED, "token": "0x" + "11" * 20}),
        (268_000 + 19_500 - 5, {"cost": 0, "fee": 5}),
        (0, {"cost": 0, "fee": 287_500}),
        (0, {"cost": 0, "fee": 10**18}),
        (19_500 - 5, {"cost": COVERED, "fee": 5}),
    ],
)
def test_fee_and_emission_cover_the_gas(lacking: int, terms: dict[str, Any]) -> None:
    assert made().lacking(pair(**terms)) == lacking


def test_where_gas_is_worth_more_it_takes_more_to_cover_it() -> None:
    free = made(emission=200)
    assert [free.lacking(pair(cost=cost)) for cost in (0, COVERED, 2 * COVERED)] == [2 * 268_000, COVERED, 0]
    assert "0.000638 XRT" in free.why(pair())


@pytest.mark.parametrize(
    ("lacking", "fee", "terms"),
    [
        (0, 16_300, {"cost": COVERED}),
        (16_299, 1, {"cost": COVERED}),
        (0, 268_000 + 16_300, {"cost": 0}),
        (COVERED + 16_300, 10**18, {"cost": COVERED, "token": "0x" + "11" * 20}),
    ],
)
def test_the_fee_for_a_permit_covers_gas_if_it_is_in_xrt(lacking: int, fee: int, terms: dict[str, Any]) -> None:
    assert made().lacking(pair(**terms), permit_fee=fee) == lacking


def asked(generation: int = 3, *, token: str = TOKEN, cost: int = 0, maker: Signer = PERSON) -> PermitFeeRequest:
    return PermitFeeRequest(maker=maker.address, generation=generation, token=token, cost=cost)


@pytest.mark.parametrize(
    ("wanted", "data_gas", "fee"),
    [
        (asked(), 0, 268_000 + 16_300),
        (asked(5), 0, 224_000 + 16_300),
        (asked(cost=COVERED - 1), 0, 1 + 16_300),
        (asked(cost=COVERED), 0, 0),
        (asked(cost=COVERED), 1000, 2 * 1000 + 16_300),
        (asked(cost=COVERED, maker=PROVIDER), 0, COVERED + 16_300),
        (asked(cost=COVERED, token="0x" + "11" * 20), 0, 0),
    ],
)
def test_the_fee_that_is_wanted_for_a_permit_is_what_covers_the_gas(
    wanted: PermitFeeRequest, data_gas: int, fee: int
) -> None:
    assert made(a_day=0).permit_fee(wanted, data_gas=data_gas) == fee
    if fee and wanted.maker == PERSON.address:
        match = pair(cost=int(wanted.cost), generation=wanted.generation)
        assert not made().lacking(match, data_gas=data_gas, permit_fee=fee)
        assert made().lacking(match, data_gas=2 * data_gas, permit_fee=fee - 1) == 1


async def test_no_fee_is_wanted_while_there_are_free_contracts() -> None:
    free = made(a_day=4)
    assert free.permit_fee(asked()) == 0
    assert await free.take(pair())
    assert free.permit_fee(asked())
    assert made(a_day=0, customers=[PERSON.address]).permit_fee(asked()) == 0


def test_nothing_is_minted_for_work_among_oneself() -> None:
    alone = Match(verified_demand(cost=COVERED), verified_offer(signer=PERSON, cost=COVERED))
    own = pair(cost=COVERED, person=PROVIDER)
    assert [made().lacking(match) for match in (alone, own)] == [COVERED, COVERED]
    assert made(always_minted=True).lacking(alone) == 0


async def test_a_days_free_contracts_last_for_the_day() -> None:
    free = made(clock := SetClock(), a_day=8)
    assert [await free.take(pair()) for _ in range(3)] == [True, True, False]
    clock.pass_by(86_400 // 8 * SECOND)
    assert [await free.take(pair()) for _ in range(2)] == [True, False]
    clock.pass_by(7 * 86_400 * SECOND)
    assert free.left() == 2
    assert free.created == 3
    assert not await made(a_day=0).take(pair())


async def test_customers_get_more() -> None:
    """Those that the operator names, and one for each contract that has covered its gas."""
    free = made(a_day=0, customers=[PERSON.address])
    assert [await free.take(pair()) for _ in range(100)] == [True] * 100
    assert free.left() == 0


async def test_the_number_left_is_kept(tmp_path: Path) -> None:
    clock = SetClock()
    with MarketStore(tmp_path / "store.sqlite") as store:
        free = made(clock, store, a_day=8)
        assert await free.take(pair())
        assert await free.take(pair())
    with MarketStore(tmp_path / "store.sqlite") as store:
        free = made(clock, store, a_day=8)
        assert not await free.take(pair())
        clock.pass_by(86_400 // 8 * SECOND)
        assert await free.take(pair())


def fresh_pair(local: LocalMarket) -> tuple[Demand, Offer]:
    """A worthless pair of two new keys."""
    demand, offer = local.demand(cost=0), local.offer(cost=0)
    return (
        Signer(secrets.token_bytes(32)).sign(demand),
        Signer(secrets.token_bytes(32)).sign(offer),
    )


async def test_worthless_pairs_of_strangers_cost_a_provider_little(local: LocalMarket) -> None:
    """Beyond the day's free ones the makers are told, and orders that cover their gas become contracts as before."""
    await local.chain.tokens.approve(local.chain.factory, COVERED)
    async with local.provider(free_contracts=8) as provider:
        pairs = [fresh_pair(local) for _ in range(12)]
        for demand, offer in pairs:
            local.publish(demand, offer)
        await until(lambda: provider.earnings().created == 2)
        await until(lambda: provider.drops.totals().get("unpaid") == 10)
        await until(lambda: len(local.rejections) > 10)
        assert {rejection.reason for rejection in local.rejections} == {"unpaid"}
        assert "a cost of 0.000319 XRT does" in local.rejections[0].detail

        paid = local.demand(cost=COVERED)
        local.publish(paid, local.offer(cost=COVERED))
        await local.liability_of(paid)
        assert provider.earnings().created == 3


async def test_a_declined_demand_waits_for_an_offer_that_pays(local: LocalMarket) -> None:
    fee = 287_500
    async with local.chain_of("robot") as robots:
        await robots.tokens.approve(robots.factory, fee)
    async with local.provider(free_contracts=0) as provider:
        local.publish(demand := local.demand(cost=0), local.offer(cost=0))
        await until(lambda: len(local.rejections) == 2)
        assert order_id(verify_message(demand)) in provider.book
        local.publish(local.offer(cost=0, lighthouse_fee=fee))
        liability = await local.liability_of(demand)
        assert liability.lighthouse_fee == fee


async def test_a_customer_has_a_free_contract_for_each_that_covered_its_gas(local: LocalMarket) -> None:
    await local.chain.tokens.approve(local.chain.factory, COVERED)
    async with local.provider(free_contracts=0) as provider:
        local.publish(paid := local.demand(cost=COVERED), local.offer(cost=COVERED))
        liability = await local.liability_of(paid)
        local.publish(local.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)
        wanted = asked(token=local.chain.xrt, maker=local.accounts["person"].signer)
        assert provider.free.permit_fee(wanted) == 0
        local.publish(free := local.demand(cost=0), local.offer(cost=0))
        await local.liability_of(free)
        assert provider.free.permit_fee(wanted)
        local.publish(local.demand(cost=0), local.offer(cost=0))
        await until(lambda: len(local.rejections) == 2)

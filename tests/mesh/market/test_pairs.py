"""Pairs: a demand and an offer that their maker gives to a provider together, and that nobody else can use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh.network import ServiceFailed, call
from schemas import verify_message
from schemas.rpc import OrderPair, PairTaken, SendDemand, SendOffer
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.market.provider import Provider
    from schemas import Demand, Offer
    from tests.support.provider.local_market import LocalMarket


def pair_of(local: LocalMarket, demand: Demand, offer: Offer, role: str = "person", maker: str = "") -> OrderPair:
    """A demand bound to an offer by a role, or in the name of another `maker`."""
    sent = SendDemand.of(demand), SendOffer.of(offer)
    return OrderPair(demand=sent[0], offer=sent[1], maker=maker or local.address(role)).signed_by(
        local.accounts[role].signer
    )


async def send(local: LocalMarket, pair: OrderPair, provider: str = "provider") -> PairTaken:
    """What a provider replies, once it offers the service."""

    found: list[PairTaken] = []

    async def asked() -> bool:
        try:
            found.append(await call(local.session, local.address(provider), "pair", pair))
        except ServiceFailed as error:
            if error.reason != "no-agent":
                raise
        return bool(found)

    await until_found(asked, what="the service")
    return found[0]


async def idle(provider: Provider) -> None:
    """Wait until a provider has nothing under way."""
    await until(lambda: provider.queue.waiting == 0)


async def test_a_pair_becomes_one_contract_however_often_it_is_sent(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand, offer = local.demand(), local.offer()
        pair = pair_of(local, demand, offer)
        assert [await send(local, pair) for _ in range(3)] == [PairTaken()] * 3
        assert (await local.liability_of(demand)).promisor == local.address("robot")
        await send(local, pair)  # a replay, after the contract
        await until(lambda: provider.earnings().created == 1)
        await idle(provider)
        assert len(await local.liabilities_of(demand)) == provider.ledger.turnover()[0] == 1


async def test_what_is_published_of_a_pair_is_matched_with_nothing_else(local: LocalMarket) -> None:
    """A provider that did not keep it to itself has published both; another robot and another person are quick."""
    async with local.provider() as provider:
        demand, offer = local.demand(), local.offer()
        assert await send(local, pair_of(local, demand, offer)) == PairTaken()
        local.publish(demand, offer, local.offer("rival"), local.demand("poor"))
        await until(lambda: provider.drops.totals().get("paired", 0) >= 1)
        assert (await local.liability_of(demand)).promisor == local.address("robot")
        assert (await local.liability_of(offer)).promisee == local.address("person")


@pytest.mark.parametrize("known", ["in the book", "not known"])
async def test_only_the_maker_of_a_demand_can_bind_it(local: LocalMarket, known: str) -> None:
    async with local.provider() as provider:
        demand, rival = local.demand(), local.offer("rival")
        if known == "in the book":
            local.publish(demand)
            await until(lambda: len(provider.book) == 1)
        by_rival = pair_of(local, demand, rival, role="rival")
        in_its_name = pair_of(local, demand, rival, role="rival", maker=local.address("person"))
        assert [(await send(local, one)).code for one in (by_rival, in_its_name)] == ["maker", "signature"]
        assert await send(local, pair_of(local, demand, local.offer())) == PairTaken()
        assert (await local.liability_of(demand)).promisor == local.address("robot")
        assert len(provider.book) == 0


async def test_a_leaked_offer_stays_with_its_first_demand(local: LocalMarket) -> None:
    async with local.provider():
        demand, offer, other = local.demand(), local.offer(), local.demand("rival")
        assert await send(local, pair_of(local, demand, offer)) == PairTaken()
        assert (await send(local, pair_of(local, other, offer, role="rival"))).code == "duplicate"
        assert (await local.liability_of(offer)).promisee == local.address("person")


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"cost": 1}, "terms"),
        ({"deadline": 1}, "deadline"),
        ({"lighthouse": "0x" + "12" * 20}, "lighthouse"),
        ({"signature": "00" * 64 + "1b"}, "signature"),
    ],
)
async def test_a_pair_that_can_be_no_contract_is_refused(
    local: LocalMarket, changes: dict[str, Any], code: str
) -> None:
    async with local.provider() as provider:
        offer = local.offer(**{name: value for name, value in changes.items() if name != "signature"})
        if "signature" in changes:
            offer = replace(offer, **changes)
        assert (await send(local, pair_of(local, local.demand(), offer))).code == code
        assert provider.ledger.turnover()[0] == 0


async def test_a_pair_whose_maker_can_not_pay_is_not_kept(local: LocalMarket) -> None:
    async with local.chain_of("poor") as poor:
        await poor.tokens.approve(poor.factory, 0)  # other tests of this chain have approved more
    async with local.provider() as provider:
        demand, offer = local.demand("poor", cost=5), local.offer(cost=5)
        taken = await send(local, pair_of(local, demand, offer, role="poor"))
        assert taken.code == "ERC20InsufficientAllowance"
        assert not provider.orders.is_paired(verify_message(demand))
        assert len(provider.book) == 0


async def test_a_withdrawn_pair_is_refused(local: LocalMarket) -> None:
    async with local.provider() as provider:
        demand = local.demand()
        local.publish(local.withdrawal(demand))
        await until(lambda: len(provider.withdrawals) == 1)
        assert (await send(local, pair_of(local, demand, local.offer()))).code == "withdrawn"


async def test_each_of_two_providers_that_know_a_pair_leaves_it_alone(local: LocalMarket) -> None:
    await local.create_lighthouse(timeout_blocks=20, provider=1, rival=1)
    async with local.provider() as first, local.provider("rival") as second:
        demand, offer = local.demand(), local.offer()
        pair = pair_of(local, demand, offer)
        assert [await send(local, pair, one) for one in ("provider", "rival")] == [PairTaken()] * 2
        local.publish(demand, local.offer("poor"))
        assert (await local.liability_of(demand)).promisor == local.address("robot")
        await until(lambda: first.earnings().created + second.earnings().created == 1)
        assert all(
            verify_message(demand).hash not in {one.hash for one in each.book.orders()} for each in (first, second)
        )

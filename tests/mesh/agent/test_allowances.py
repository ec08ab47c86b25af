"""Allowances: the factory may take the cost of open orders, also when they change during an approval."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Allowances, Chain, InsufficientTokens
from mesh.testing._market import TIMING
from schemas import Demand, Offer
from tests.support.orders import terms

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from mesh.chain.rpc import Transport
    from tests.support.market import Place


class Overtaken:
    """The chain, on which something happens before each transaction of ours gets there."""

    def __init__(self, chain: Transport) -> None:
        self._chain = chain
        self.meanwhile: Callable[[], Awaitable[object]] | None = None

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_sendRawTransaction" and self.meanwhile is not None:
            meanwhile, self.meanwhile = self.meanwhile, None
            await meanwhile()
        return await self._chain.make_request(method, params)


@pytest.fixture
def road(place: Place) -> Overtaken:
    return Overtaken(place.node.provider)


@pytest.fixture
async def chain(place: Place, road: Overtaken) -> AsyncIterator[Chain]:
    """The chain as the person uses it, with no allowance given."""
    async with Chain(
        road,
        account=place.market.accounts["person"],
        contracts=place.market.deployment.contracts,
        timing=TIMING,
    ) as opened:
        await opened.tokens.approve(opened.factory, 0)
        yield opened


@pytest.fixture
def allowances(place: Place, chain: Chain) -> Allowances:
    return Allowances(chain.tokens, chain.factory, place.address("person"))


async def allowance(chain: Chain) -> int:
    assert chain.account is not None
    return await chain.tokens.allowance(chain.account.address, chain.factory)


async def spend(place: Place, cost: int) -> None:
    """Have the factory take `cost` from the person, by a contract with the robot."""
    deployment = place.market.deployment
    fields = terms(token=deployment.xrt, cost=cost, lighthouse=deployment.lighthouse, nonce=secrets.token_hex(32))
    demand = place.market.accounts["person"].signer.sign(Demand(**fields, validator_fee=0))
    offer = place.market.accounts["robot"].signer.sign(Offer(**fields, lighthouse_fee=0))
    await place.chains["provider"].liabilities.create(deployment.lighthouse_name, demand, offer)


async def test_the_costs_of_open_orders_add_up(chain: Chain, allowances: Allowances) -> None:
    await allowances.ensure("one", {chain.xrt: 10})
    await allowances.ensure("other", {chain.xrt: 5})
    assert await allowance(chain) == 15


async def test_a_sufficient_allowance_costs_no_transaction(chain: Chain, allowances: Allowances) -> None:
    await chain.tokens.approve(chain.factory, 100)
    before = await chain.block_number()
    await allowances.ensure("one", {chain.xrt: 100})
    assert await chain.block_number() == before


async def test_an_order_without_cost_needs_no_allowance(chain: Chain, allowances: Allowances) -> None:
    before = await chain.block_number()
    await allowances.ensure("one", {chain.xrt: 0})
    assert await chain.block_number() == before


async def test_a_released_order_no_longer_counts(chain: Chain, allowances: Allowances) -> None:
    balance = await chain.tokens.balance()
    await allowances.ensure("one", {chain.xrt: balance})
    with pytest.raises(InsufficientTokens) as caught:
        await allowances.ensure("other", {chain.xrt: 1})
    assert caught.value.needed == balance + 1
    allowances.release("one")
    allowances.release("never promised")
    await allowances.ensure("other", {chain.xrt: balance})


async def test_an_allowance_used_up_meanwhile_is_approved_again(
    place: Place, road: Overtaken, chain: Chain, allowances: Allowances
) -> None:
    """Gas is estimated for changing an allowance; setting one that is used up costs more."""
    await chain.tokens.approve(chain.factory, 100)
    spent: list[int] = []

    async def spend_all() -> None:
        await spend(place, 100)
        spent.append(100)

    road.meanwhile = spend_all
    await allowances.ensure("one", {chain.xrt: 150})
    assert spent == [100]
    assert await allowance(chain) == 150

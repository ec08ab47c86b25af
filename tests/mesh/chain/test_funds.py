"""What makers of orders can pay, asked in batches."""

from __future__ import annotations

import asyncio
import secrets
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Timing
from mesh.chain.funds import BATCH, Funding, Holding
from schemas import Demand, Signer, Verified, verify_message
from tests.mesh.market.tokens import BURNS_ALL_GAS, deploy_token, refuses_with
from tests.support import orders

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

SLOW = Timing(poll_interval=60.0)
"""Answers are used for three of its intervals."""

pytestmark = pytest.mark.asyncio(loop_scope="module")


def demand_of(market: DeployedMarket, signer: Signer, **changes: Any) -> Verified[Demand]:
    return verify_message(orders.demand(signer=signer, **({"token": market.deployment.xrt} | changes)))


async def test_an_order_is_covered_by_balance_and_allowance(market: DeployedMarket) -> None:
    person = market.promisee
    async with market.chain(person) as chain:
        await chain.tokens.approve(chain.factory, 1000)
        balance = await chain.tokens.balance()
        assert await chain.funds.of(Holding(chain.xrt, person.address)) == Funding(balance, 1000)
        assert await chain.costs.can_be_paid(demand_of(market, person.signer, cost=1000))
        assert await chain.costs.can_be_paid(demand_of(market, person.signer, cost=0, validator_fee=1000))
        assert not await chain.costs.can_be_paid(demand_of(market, person.signer, cost=1001))
        assert not await chain.costs.can_be_paid(demand_of(market, person.signer, cost=600, validator_fee=600))
        await chain.tokens.approve(chain.factory, balance + 5)
        assert not await chain.costs.can_be_paid(demand_of(market, person.signer, cost=balance + 1), fresh=True)
        assert await chain.costs.can_be_paid(demand_of(market, person.signer, cost=balance), fresh=True)


async def test_fresh_keys_cost_few_requests_and_a_second_look_none(market: DeployedMarket) -> None:
    made = [demand_of(market, Signer(secrets.token_bytes(32)), cost=1) for _ in range(300)]
    async with market.chain(timing=SLOW) as chain:
        assert not any(await asyncio.gather(*(chain.costs.can_be_paid(demand) for demand in made)))
        assert chain.funds.requests == -(-300 // BATCH)
        assert not any(await asyncio.gather(*(chain.costs.can_be_paid(demand) for demand in made)))
        assert chain.funds.requests == -(-300 // BATCH)
        assert await chain.costs.can_be_paid(demand_of(market, market.stranger.signer, cost=0))
        assert chain.funds.requests == -(-300 // BATCH), "what costs nothing needs no question"


@pytest.mark.parametrize("code", [BURNS_ALL_GAS, refuses_with("Nonsense(uint256,uint256)"), b"\x00"])
async def test_a_strangers_token_spoils_no_other_answer(market: DeployedMarket, code: bytes) -> None:
    async with market.chain(market.stranger) as chain:
        strange, person = await deploy_token(chain, code), market.promisee
        holdings = [Holding(token, person.address) for token in (strange, chain.xrt)]
        unreadable, read = await asyncio.gather(*(chain.funds.of(holding) for holding in holdings))
        assert unreadable is None
        assert read is not None
        assert read.balance == await chain.tokens.balance(person.address)
        assert await chain.costs.can_be_paid(demand_of(market, person.signer, token=strange, cost=1))

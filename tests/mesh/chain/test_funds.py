"""What makers of orders can pay, asked in batches."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import RequestRefused, Timing
from mesh.chain._tokens import FUNDS_LIMITS, NO_TOKEN, Funding, Holding
from schemas import Demand, Signer, Verified, verify_message
from tests.support import orders
from tests.support.provider.tokens import BURNS_ALL_GAS, deploy_token, refuses_with
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.market.book import Order
    from tests.mesh.chain.conftest import DeployedMarket

SLOW = Timing(poll_interval=60.0)
"""Answers are used for three of its intervals."""

pytestmark = pytest.mark.asyncio(loop_scope="module")


def demand_of(market: DeployedMarket, signer: Signer, **changes: Any) -> Verified[Demand]:
    return verify_message(orders.demand(signer=signer, **({"token": market.deployment.xrt} | changes)))


async def can_be_paid(chain: Chain, *orders: Verified[Order], fresh: bool = False) -> bool:
    """Whether the makers of all these orders can pay."""
    return not any(await chain.funds.shortages(orders, fresh=fresh))


async def test_an_order_is_covered_by_balance_and_allowance(market: DeployedMarket) -> None:
    person = market.promisee
    async with market.chain(person) as chain:
        await chain.tokens.approve(chain.factory, 1000)
        balance = await chain.tokens.balance()
        holding = Holding(chain.xrt, person.address)
        assert await chain.funds.of([holding]) == {holding: Funding(balance, 1000)}
        assert await can_be_paid(chain, demand_of(market, person.signer, cost=1000))
        assert await can_be_paid(chain, demand_of(market, person.signer, cost=0, validator_fee=1000))
        assert not await can_be_paid(chain, demand_of(market, person.signer, cost=1001))
        assert not await can_be_paid(chain, demand_of(market, person.signer, cost=600, validator_fee=600))
        await chain.tokens.approve(chain.factory, balance + 5)
        assert not await can_be_paid(chain, demand_of(market, person.signer, cost=balance + 1), fresh=True)
        assert await can_be_paid(chain, demand_of(market, person.signer, cost=balance), fresh=True)


async def test_fresh_keys_cost_few_requests_and_a_second_look_none(
    market: DeployedMarket, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [demand_of(market, Signer(secrets.token_bytes(32)), cost=1) for _ in range(300)]
    asked = 0
    async with market.chain(timing=SLOW) as chain:
        call_all = chain.node.call_all

        async def counted(*arguments: Any, **options: Any) -> list[bytes | None]:
            nonlocal asked
            asked += 1
            return await call_all(*arguments, **options)

        monkeypatch.setattr(chain.node, "call_all", counted)
        assert await chain.funds.shortages(made) == 300 * ["ERC20InsufficientAllowance"]
        assert asked == -(-300 // FUNDS_LIMITS.accounts)
        assert await chain.funds.shortages(made) == 300 * ["ERC20InsufficientAllowance"]
        assert asked == -(-300 // FUNDS_LIMITS.accounts)
        assert await can_be_paid(chain, demand_of(market, market.stranger.signer, cost=0))
        assert asked == -(-300 // FUNDS_LIMITS.accounts), "what costs nothing needs no question"


async def test_who_pays_in_can_pay_soon(market: DeployedMarket) -> None:
    person = market.promisee
    async with market.chain(person) as chain:
        await chain.tokens.approve(chain.factory, 5)
        demands = [demand_of(market, person.signer, cost=cost) for cost in (5, 6)]
        assert await chain.funds.shortages(demands) == ["", "ERC20InsufficientAllowance"]
        await chain.tokens.approve(chain.factory, 6)
        await until_found(lambda: can_be_paid(chain, *demands))


@pytest.mark.parametrize("code", [BURNS_ALL_GAS, refuses_with("Nonsense(uint256,uint256)"), b"\x00"])
async def test_what_tells_no_balances_is_no_token_and_spoils_no_other_answer(
    market: DeployedMarket, code: bytes
) -> None:
    async with market.chain(market.stranger) as chain:
        strange, person = await deploy_token(chain, code), market.promisee
        unreadable, readable = (Holding(token, person.address) for token in (strange, chain.xrt))
        known = await chain.funds.of([unreadable, readable])
        assert known[unreadable] == NO_TOKEN
        assert (read := known[readable]) is not None
        assert read.balance == await chain.tokens.balance(person.address)
        demand = demand_of(market, person.signer, token=strange, cost=1)
        assert await chain.funds.shortages([demand]) == ["TokenUnreadable"]


async def test_tokens_that_use_up_the_gas_of_a_request_hide_nobodys_funds(market: DeployedMarket) -> None:
    async with market.chain(market.stranger) as chain:
        strange, person = await deploy_token(chain, BURNS_ALL_GAS), market.promisee
        burning = [Holding(strange, Signer(secrets.token_bytes(32)).address) for _ in range(FUNDS_LIMITS.accounts - 1)]
        asked, call_all = list[int](), chain.node.call_all

        async def counted(calls: Any, **options: Any) -> Any:
            asked.append(len(calls))
            return await call_all(calls, **options)

        chain.node.call_all = counted  # type: ignore[method-assign]
        known = await chain.funds.of([*burning, honest := Holding(chain.xrt, person.address)])
        assert (read := known[honest]) is not None
        assert read.balance == await chain.tokens.balance(person.address)
        assert {known[holding] for holding in burning} == {NO_TOKEN}
        assert len(asked) < 10


async def test_what_a_node_refuses_is_not_held_against_a_maker(market: DeployedMarket) -> None:
    async with market.chain() as chain:

        async def refuse(*arguments: object, **options: object) -> bytes:
            raise RequestRefused("eth_call", -32000, "no")

        chain.node.call = refuse  # type: ignore[method-assign]
        assert await can_be_paid(chain, demand_of(market, market.stranger.signer, cost=1))

"""Chains of the OP type, which charge for the data of transactions beside their gas."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.statement import read_statement
from mesh.chain import Account, InsufficientFunds, Node, TransactionSender
from mesh.chain._node import NODE_PACE, DataFees
from mesh.dev import EmbeddedChain
from mesh.market.provider import check_account
from mesh.market.transactions import LEAST_GAS, least_cost
from mesh.network import call
from schemas import order_abi
from schemas.rpc import PermitFeeRequest
from tests.mesh.market.test_free_contracts import COVERED
from tests.support.provider.local_market import LocalMarket
from tests.support.rollups import OpStack, data_fee
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.testing import MarketChain
    from tests.support.routers import EmbeddedRouter


@pytest.fixture
async def local(market_chain: MarketChain, router: EmbeddedRouter) -> AsyncIterator[LocalMarket]:
    """A market on a chain of the OP type."""
    node = OpStack(market_chain.node.provider)
    keys = market_chain.node.funded_keys
    async with LocalMarket(market_chain.market, router.endpoint, node=node, keys=keys) as opened:
        yield opened


def line_of(local: LocalMarket) -> OpStack:
    assert isinstance(local.node, OpStack)
    return local.node


async def test_the_fee_for_data_counts_as_spent(local: LocalMarket) -> None:
    await local.chain.tokens.approve(local.chain.factory, COVERED)
    async with local.provider(free_contracts=8) as provider:
        local.publish(demand := local.demand(cost=COVERED), local.offer(cost=COVERED))
        liability = await local.liability_of(demand)
        local.publish(local.result(liability.address))
        await until(lambda: provider.earnings().finalized == 1)
        spent = provider.earnings().spent
        assert provider.earnings().created == 1
    dated = next(one for one in await local.chain.liabilities.history() if one.liability.address == liability.address)
    assert dated.ended is not None
    transactions = [dated.created.tx, dated.ended.tx]
    receipts = [await local.chain.node.receipt(tx) for tx in transactions]
    gas = sum(one.gas_used * (one.effective_gas_price or 0) for one in receipts if one is not None)
    fees = sum(map(line_of(local).charged, transactions))
    assert fees > 0
    assert spent == gas + fees
    statement = await read_statement(local.chain, local.address("provider"))
    assert [one for one in statement.entries if one.liability.address == liability.address] == []  # it is no party
    statement = await read_statement(local.chain, local.address("person"))
    assert [one.gas for one in statement.entries if one.liability.address == liability.address] == [gas + fees]


async def test_the_metrics_name_the_part_for_data(local: LocalMarket) -> None:
    async with local.chain_of("provider") as chain:
        receipt = await TransactionSender(chain.node, local.accounts["provider"]).send(
            to=local.address("robot"), data=b"", value=1
        )
        families = {family.name: family for family in chain.node.families()}
        values = {name: families[f"aira_{name}_wei_total"].samples[0].value for name in ("gas_spent", "data_spent")}
        fee = line_of(local).charged(receipt.tx)
        assert values == {"gas_spent": float(receipt.wei), "data_spent": float(fee)}
        assert receipt.wei > fee > 0


async def test_what_data_will_cost_is_estimated_by_the_oracle_which_is_asked_once_a_minute(local: LocalMarket) -> None:
    demand, offer = local.demand(cost=COVERED), local.offer(cost=COVERED)
    node, line = local.chain.node, line_of(local)
    asked = line.asked
    for order in (demand, offer):
        data = order_abi(order)
        assert await node.data_fee(data) == pytest.approx(data_fee(data), rel=0.35)
    assert line.asked - asked <= 1
    estimated = await local.chain.liabilities.data_gas(demand, offer)
    price = (await node.gas_market()).price
    assert estimated * price >= await node.data_fee(order_abi(demand) + order_abi(offer))


async def test_a_contract_must_cover_its_data_too(local: LocalMarket) -> None:
    """Emission pays for gas only: what covers a contract elsewhere does not here, but a fee in the offer does."""
    async with local.chain_of("robot") as robots:
        await robots.tokens.approve(robots.factory, 10**12)
    await local.chain.tokens.approve(local.chain.factory, COVERED)
    async with local.provider(free_contracts=0) as provider:
        local.publish(demand := local.demand(cost=COVERED), offer := local.offer(cost=COVERED))
        rejection = await local.rejection_of(offer)
        assert (rejection.reason, provider.earnings().created) == ("unpaid", 0)
        lacking = await local.chain.liabilities.data_gas(demand, offer)
        assert "in the offer does" in rejection.detail
        local.publish(local.offer(cost=COVERED, lighthouse_fee=2 * lacking + 20_000))
        assert (await local.liability_of(demand)).cost == COVERED


async def test_the_fee_that_is_wanted_for_a_permit_covers_its_data_too(local: LocalMarket) -> None:
    person, xrt = local.address("person"), local.chain.xrt
    await local.chain.tokens.approve(local.chain.factory, 0)
    wanted = PermitFeeRequest(maker=person, generation=3, token=xrt, cost=COVERED)
    async with local.provider(free_contracts=0) as provider:
        fee = int((await call(local.session, provider.address, "permit-fee", wanted)).fee)
        demand, offer = local.demand(cost=COVERED, validator_fee=fee), local.offer(cost=COVERED)
        assert fee - 16_300 > await local.chain.liabilities.data_gas(demand, offer)
        permit = await local.chain.permits.sign(xrt, COVERED + fee)
        assert permit is not None
        local.publish(permit, demand, offer)
        assert (await local.liability_of(demand)).validator_fee == fee
        assert provider.earnings().fees == fee


async def test_a_provider_needs_the_fee_for_data_too(local: LocalMarket) -> None:
    async with local.chain_of("provider") as chain:
        assert await least_cost(chain.node) > LEAST_GAS * await chain.node.gas_price()
    poor = Account(b"\x77" * 32)
    async with local.chain_of("provider") as chain:
        await check_account(chain, local.market)
        sender = TransactionSender(chain.node, chain.account or poor)
        await sender.send(to=poor.address, data=b"", value=10**9)
        data = b"\x01" * 2_000
        with pytest.raises(InsufficientFunds) as lacking:
            await TransactionSender(chain.node, poor).send(to=local.address("robot"), data=data, value=10**9)
        assert lacking.value.needed > 10**9 + data_fee(data) // 2


async def test_a_chain_without_the_oracle_is_asked_once() -> None:
    asked: Counter[str] = Counter()

    class Line:
        async def make_request(self, method: str, params: Any) -> Any:
            asked[method] += 1
            return await chain.provider.make_request(method, params)

    async with EmbeddedChain() as chain, Node(Line()) as node:
        assert [await node.data_fee(b"\x01" * 100) for _ in range(3)] == [0, 0, 0]
        assert await node.data_gas(b"\x01") == 0
    assert asked["eth_call"] == 1


async def test_an_empty_answer_by_mistake_does_not_end_the_fees(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [b"", (3200).to_bytes(32), b"", (6400).to_bytes(32)]

    async def oracle(data: bytes) -> bytes:
        return answers.pop(0)

    now = 0.0
    monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: now)
    fees, found = DataFees(oracle), []
    for wait in (0.0, NODE_PACE.no_oracle, NODE_PACE.data_fee, NODE_PACE.data_fee):
        now += wait
        found.append(await fees.of(b"\x01" * 36) // 100)
    assert found == [0, 3, 3, 6]

"""Following the chain from a cursor."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import (
    XRT,
    Account,
    Approval,
    BlockEvents,
    Chain,
    ChainWentBack,
    Finalized,
    NewLiability,
    NewLighthouse,
    NodeUnreachable,
    NotALiability,
    Transfer,
    deploy,
)
from mesh.chain.errors import RequestRefused
from mesh.chain.following import FOLLOW_LIMITS
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from mesh.dev._rpc import RpcError
from schemas.address import ZERO_ADDRESS
from tests.mesh.chain.conftest import QUICK, Flaky, events_of, read_to, unreachable
from tests.support.log_events import logged_events, logged_facts
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def test_the_events_of_a_whole_job_are_yielded(market: DeployedMarket) -> None:
    cost = 5 * XRT
    async with market.chain(market.provider) as chain:
        start = await chain.block_number()
        created = await chain.liabilities.create("airalab", market.demand(cost=cost), market.offer(cost=cost))
        result = market.result(created.liability)
        settled = await chain.liabilities.finalize("airalab", result)
        head = await chain.block_number()
        events = events_of(await read_to(chain, start + 1, head))
    factory = market.deployment.factory
    assert NewLiability(created.liability, created.tx) in events
    assert Finalized(created.liability, True, result.result, settled.tx) in events
    assert Transfer(market.promisee.address, factory, cost, created.tx) in events
    assert Transfer(factory, market.promisor.address, cost, settled.tx) in events
    minted = [event for event in events if isinstance(event, Transfer) and event.sender == ZERO_ADDRESS]
    assert [event.recipient for event in minted] == [market.provider.address]


async def test_new_lighthouses_are_yielded(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        events = events_of(await read_to(chain, 0, await chain.block_number()))
    assert next(event.name for event in events if isinstance(event, NewLighthouse)) == "airalab"


async def test_an_approval_is_yielded(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        tx = await chain.tokens.approve(market.stranger.address, 17)
        head = await chain.block_number()
        assert events_of(await read_to(chain, head, head)) == [
            Approval(market.promisee.address, market.stranger.address, 17, tx)
        ]


async def test_a_refund_is_yielded_without_a_result(market: DeployedMarket) -> None:
    async with market.chain(market.provider) as chain:
        created = await chain.liabilities.create("airalab", market.demand(cost=1), market.offer(cost=1))
        while await chain.block_number() + 1 < await chain.liabilities.refundable_from(created.liability):
            await chain.tokens.approve(market.stranger.address, 0)
        settled = await chain.liabilities.refund(created.liability)
        head = await chain.block_number()
        events = events_of(await read_to(chain, head, head))
    assert Finalized(created.liability, False, "", settled.tx) in events


async def test_block_numbers_grow_and_the_head_is_yielded_without_events(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        await chain.tokens.send_eth(market.stranger.address, 1)
        head = await chain.block_number()
        blocks = await read_to(chain, 0, head)
    numbers = [block.block_number for block in blocks]
    assert numbers == sorted(set(numbers))
    assert blocks[-1] == BlockEvents(head, ())


async def test_new_blocks_are_yielded_and_a_cursor_resumes(market: DeployedMarket) -> None:
    async with market.chain(market.promisee) as chain:
        cursor = await chain.block_number() + 1
        reading = asyncio.create_task(read_to(chain, cursor, cursor + 1))
        await chain.tokens.approve(market.stranger.address, 1)
        await chain.tokens.approve(market.stranger.address, 2)
        live = await reading
        again = await read_to(chain, cursor, cursor + 1)
        rest = await read_to(chain, cursor + 1, cursor + 1)
    assert events_of(live) == events_of(again)
    assert events_of(rest) == events_of(again)[1:]


async def test_a_cursor_past_the_head_is_an_error(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        head = await chain.block_number()
        with pytest.raises(ChainWentBack) as caught:
            await read_to(chain, head + 2, head + 2)
    assert (caught.value.cursor, caught.value.head) == (head + 2, head)


async def test_events_of_another_factorys_liabilities_are_left_out(market: DeployedMarket) -> None:
    """A second factory on the same chain makes liabilities of its own; the first does not report them."""
    async with market.chain(market.deployer) as chain:
        other = await deploy(chain.node, market.deployer)
    elsewhere: dict[str, Any] = {"lighthouse": other.lighthouse, "token": other.xrt}
    options = {"ens": other.ens}
    async with market.chain(market.deployer, **options) as theirs:
        await theirs.tokens.transfer(market.provider.address, XRT)
    async with market.chain(market.provider, **options) as theirs, market.chain() as ours:
        start = await theirs.block_number()
        await theirs.tokens.approve(other.lighthouse, XRT)
        await theirs.lighthouses.refill(other.lighthouse, XRT)
        created = await theirs.liabilities.create(
            other.lighthouse, market.demand(**elsewhere), market.offer(**elsewhere)
        )
        await theirs.liabilities.finalize(other.lighthouse, market.result(created.liability))
        head = await theirs.block_number()
        assert [type(event) for event in events_of(await read_to(theirs, start + 1, head))][-1] is Finalized
        assert events_of(await read_to(ours, start + 1, head)) == []


class _Choosy(EmbeddedProvider):
    """An embedded chain that, like many public nodes, answers only short ranges of logs."""

    def __init__(self, chain: EmbeddedChain, *, limit: int) -> None:
        super().__init__(chain)
        self.limit = limit
        self.ranges: list[int] = []
        self.has_receipts = True

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_getLogs":
            query = params[0]
            one = "blockHash" in query
            span = 1 if one else int(query["toBlock"], 16) - int(query["fromBlock"], 16) + 1
            self.ranges.append(span)
            if span > self.limit:
                refused = RpcError(-32005, "query returned more than 10000 results")
                return {"jsonrpc": "2.0", "id": 1, "error": refused.as_object()}
        if method == "eth_getBlockByHash" and not self.has_receipts:
            return {"jsonrpc": "2.0", "id": 1, "error": RpcError(-32601, "not here").as_object()}
        return await super().make_request(method, params)


async def test_a_node_that_refuses_long_ranges_is_asked_for_shorter_ones(caplog: pytest.LogCaptureFixture) -> None:
    async with EmbeddedChain() as node:
        deployer = await _prepare_lonely(node)
        async with Chain(node.provider, account=deployer, timing=QUICK) as chain:
            for value in range(60):
                await chain.tokens.approve(deployer.address, value)
            await node.mine(FOLLOW_LIMITS.recent)
            everything = events_of(await read_to(chain, 0, await chain.block_number()))
        choosy = _Choosy(node, limit=10)
        async with Chain(choosy, timing=QUICK) as chain:
            head = await chain.block_number()
            blocks = await read_to(chain, 0, head)
        assert events_of(blocks) == everything
        assert blocks[-1].block_number == head
        assert min(choosy.ranges) >= 5

        choosy.limit = 0
        choosy.has_receipts = False
        async with Chain(choosy, timing=QUICK) as chain, aclosing(chain.follow(0)) as events:
            reading = asyncio.create_task(anext(events))
            await until(lambda: "chain-outage" in logged_events(caplog))
            choosy.limit = 10
            assert await reading == blocks[0]
        assert logged_facts(caplog, "chain-outage") == [{"code": RequestRefused.code}]


async def _prepare_lonely(node: EmbeddedChain) -> Account:
    """Contracts and nothing else; the account that deployed them."""
    deployer = Account(node.funded_keys[0])
    await deploy(node.provider, deployer)
    return deployer


async def test_following_continues_after_an_outage(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with EmbeddedChain() as node:
        await _prepare_lonely(node)
        flaky = Flaky(node)
        async with Chain(flaky, timing=QUICK) as chain:
            head = await chain.block_number()
            events = chain.follow(head + 1)
            waiting = asyncio.create_task(anext(events))
            flaky.is_lost = True
            await until(lambda: "chain-outage" in logged_events(caplog))
            with unreachable("wire is cut"):
                await chain.block_number()
            assert not waiting.done()
            flaky.is_lost = False
            await until(lambda: "chain-recovered" in logged_events(caplog))
            await node.mine(1)
            assert await waiting == BlockEvents(head + 1, ())
        assert logged_facts(caplog, "chain-outage") == [{"code": NodeUnreachable.code}]


async def test_a_question_is_repeated_until_the_node_answers(caplog: pytest.LogCaptureFixture) -> None:
    async with EmbeddedChain() as node:
        await _prepare_lonely(node)
        flaky = Flaky(node)
        async with Chain(flaky, timing=QUICK) as chain:
            flaky.is_lost = True
            asking = asyncio.create_task(chain.retrying(chain.block_number))
            await until(lambda: "chain-outage" in logged_events(caplog))
            flaky.is_lost = False
            assert await asking == await chain.block_number()
            with pytest.raises(NotALiability):
                await chain.retrying(lambda: chain.liabilities.get(chain.factory))
    assert logged_events(caplog).count("chain-outage") == 1

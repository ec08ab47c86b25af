"""Reading events from nodes whose machines are of different ages, and from nodes that restrict `eth_getLogs`."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Account, Chain, Finalized, Node, deploy, following
from mesh.chain._node import NODE_LIMITS
from mesh.chain.errors import NodeUnreachable
from mesh.chain.following import topics_of
from mesh.dev import EmbeddedChain
from mesh.errors import ConfigurationError
from tests.mesh.chain.conftest import QUICK, events_of, read_to
from tests.support.lagging_nodes import LaggingCalls, LaggingPool, RestrictedLogs
from tests.support.log_events import logged_events
from tests.support.raising import raises_with
from tests.support.waiting import until

if TYPE_CHECKING:
    from tests.mesh.chain.conftest import DeployedMarket

pytestmark = pytest.mark.asyncio(loop_scope="module")


async def _with_events(node: EmbeddedChain, count: int) -> Account:
    account = Account(node.funded_keys[0])
    await deploy(node.provider, account)
    async with Chain(node.provider, account=account, timing=QUICK) as chain:
        for value in range(count):
            await chain.tokens.approve(account.address, value + 1)
    return account


@pytest.mark.parametrize("knows_hashes", [False, True])
@pytest.mark.parametrize("behind", [1, 3])
async def test_no_event_is_lost_by_a_machine_that_is_behind(
    behind: int, knows_hashes: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Once while the machine catches up, and once while catching up over a range whose end the machine lacks."""
    async with EmbeddedChain() as node:
        account = await _with_events(node, 2)
        async with Chain(node.provider, account=account, timing=QUICK) as chain:
            head = await chain.block_number()
            expected = events_of(await read_to(chain, 0, head))
        pool = LaggingPool(node.provider, behind=behind, knows_hashes=knows_hashes)
        async with Chain(pool, timing=QUICK) as chain:
            assert events_of(await read_to(chain, 0, head)) == expected
            assert pool.stale
            reading = asyncio.create_task(read_to(chain, head + 1, head + 3))
            async with Chain(node.provider, account=account, timing=QUICK) as sender:
                for value in (7, 8, 9):
                    await sender.tokens.approve(account.address, value)
            assert [getattr(event, "value", 0) for event in events_of(await reading)] == [7, 8, 9]
    assert "chain-outage" not in logged_events(caplog)


@pytest.mark.parametrize(("behind", "every"), [(255, 1), (512, 2), (768, 3)])
async def test_no_event_is_lost_while_a_long_range_is_read(behind: int, every: int) -> None:
    """All requests may reach a machine that is behind by less than 256 blocks, or some of them one far behind."""
    async with EmbeddedChain() as node:
        account = await _with_events(node, 0)
        async with Chain(node.provider, account=account, timing=QUICK) as chain:
            start = await chain.block_number()
            for value in range(1, 8):
                await node.mine(127)
                await chain.tokens.approve(account.address, value)
            await node.mine(1)
            head = await chain.block_number()
        pool = LaggingPool(node.provider, behind=behind, every=every)
        async with Chain(pool, timing=QUICK) as chain:
            found = events_of(await read_to(chain, start + 1, head))
        assert [getattr(event, "value", 0) for event in found] == [1, 2, 3, 4, 5, 6, 7]
        assert pool.stale


async def test_the_end_of_a_contract_is_read_although_a_machine_does_not_know_the_contract(
    market: DeployedMarket,
) -> None:
    async with market.chain(market.provider) as chain:
        created = await chain.liabilities.create("airalab", market.demand(), market.offer())
        await chain.liabilities.finalize("airalab", market.result(created.liability))
        head = await chain.block_number()
        pool = LaggingCalls(_Passing(chain.node), behind=3)
        async with Chain(pool, contracts=market.deployment.contracts, timing=QUICK) as reader:
            (end,) = [one for one in events_of(await read_to(reader, head, head)) if isinstance(one, Finalized)]
            assert end.liability == created.liability
        async with Chain(pool, contracts=market.deployment.contracts, timing=QUICK) as reader:
            assert await reader.liabilities.exists(created.liability)
            assert not await reader.liabilities.exists(market.stranger.address)
    assert pool.refused


async def test_an_empty_answer_without_receipts_is_asked_again(caplog: pytest.LogCaptureFixture) -> None:
    async with EmbeddedChain() as node:
        account = await _with_events(node, 1)
        pool = LaggingPool(RestrictedLogs(node.provider), behind=1)
        pool.limit = 2

        async def no_receipts(method: str, params: Any) -> Any:
            if method == "eth_getTransactionReceipt":
                return {"jsonrpc": "2.0", "id": 1, "result": None}
            return await LaggingPool.make_request(pool, method, params)

        pool.make_request = no_receipts  # type: ignore[method-assign]
        pool.node = node.provider
        async with Chain(pool, timing=QUICK) as chain:
            head = await chain.block_number()
            assert [getattr(event, "value", 0) for event in events_of(await read_to(chain, head, head))] == [1]
        assert account.address
        assert pool.stale == 2
    assert "chain-outage" not in logged_events(caplog)


@pytest.mark.parametrize("has_block", [True, False])
async def test_an_empty_answer_that_nothing_proves_is_believed_at_last_if_the_node_has_the_block(
    has_block: bool, caplog: pytest.LogCaptureFixture
) -> None:
    class NoReceipts(LaggingPool):
        async def make_request(self, method: str, params: Any) -> Any:
            if "Receipt" in method or (method == "eth_getBlockByHash" and not has_block):
                return {"jsonrpc": "2.0", "id": 1, "result": None}
            return await super().make_request(method, params)

    async with EmbeddedChain() as node:
        await _with_events(node, 1)
        async with Node(NoReceipts(node.provider, behind=1), timing=QUICK) as reader:
            head, asked = await reader.heads.look(), {"addresses": (), "topics": topics_of("XRT")}
            for _ in range(NODE_LIMITS.doubts - 1):
                with raises_with(NodeUnreachable, code="missing-logs"):
                    await reader.block_logs(head, **asked)
            if has_block:
                assert await reader.block_logs(head, **asked) == []
                assert await reader.block_logs(head, **asked) == []
            else:
                with raises_with(NodeUnreachable, code="missing-logs"):
                    await reader.block_logs(head, **asked)
    assert logged_events(caplog).count("logs-unproven") == has_block


@pytest.mark.parametrize("is_off", [False, True])
async def test_nodes_that_restrict_logs_are_read_by_receipts(market: DeployedMarket, is_off: bool) -> None:
    async with market.chain(market.provider) as chain:
        start = await chain.block_number() + 1
        created = await chain.liabilities.create("airalab", market.demand(), market.offer())
        await chain.liabilities.finalize("airalab", market.result(created.liability))
        head = await chain.block_number()
        expected = events_of(await read_to(chain, start, head))
        restricted = RestrictedLogs(_Passing(chain.node), is_off=is_off)
        async with Chain(restricted, contracts=market.deployment.contracts, timing=QUICK) as reader:
            await reader.node.check_logs()
            assert events_of(await read_to(reader, start, head)) == expected


async def test_a_node_without_logs_and_receipts_is_named(market: DeployedMarket) -> None:
    async with market.chain() as chain:
        restricted = RestrictedLogs(_Passing(chain.node), is_off=True, has_receipts=False)
        async with Node(restricted, timing=QUICK) as node:
            with pytest.raises(ConfigurationError, match="refuses eth_getLogs"):
                await node.check_logs()


class _Passing:
    """Passes requests to another node, as a transport."""

    def __init__(self, node: Node) -> None:
        self._node = node

    async def make_request(self, method: str, params: Any) -> Any:
        """The result of the node."""
        return {"jsonrpc": "2.0", "id": 1, "result": await self._node.request(method, *params)}

    def __str__(self) -> str:
        return "node"


async def test_a_long_catching_up_is_told(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(following, "FOLLOW_PACE", following.FOLLOW_PACE._replace(told=0.0))
    async with EmbeddedChain() as node:
        await _with_events(node, 1)
        async with Chain(node.provider, timing=replace(QUICK)) as chain:
            await read_to(chain, 0, await chain.block_number())
    await until(lambda: "chain-catching-up" in logged_events(caplog))

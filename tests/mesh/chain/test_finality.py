"""Which blocks count: by confirmations, or by what the node calls safe or finalized; and on which chain a node is."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Chain, Node
from mesh.chain.errors import FinalityNotOffered, WrongChain
from mesh.chain.rpc import HttpTransport
from mesh.settings.chains import CHAINS, ChainProfile
from tests.mesh.chain.conftest import QUICK, prepare
from tests.support.nodes import Anvil
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SLOTS = 3
"""Of an epoch: the safe block is so far behind the latest one, the finalized one twice as far."""
BEHIND = {"safe": SLOTS, "finalized": 2 * SLOTS}


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    """A node that mines for each transaction and on request, on a chain of short epochs."""
    async with Anvil(arguments=("--slots-in-an-epoch", str(SLOTS))) as anvil:
        yield anvil


@pytest.mark.parametrize("profile", [one for one in CHAINS.values() if one.chain_id], ids=lambda one: one.name)
async def test_a_node_of_the_named_chain_is_taken_and_another_is_refused(profile: ChainProfile) -> None:
    other = CHAINS["gnosis" if profile.name != "gnosis" else "base"]
    async with Anvil(arguments=("--chain-id", str(profile.chain_id))) as anvil:
        async with Node(anvil.url, timing=QUICK, profile=profile) as node:
            assert node.chain_id == profile.chain_id
        async with Node(anvil.url, timing=QUICK, profile=CHAINS["local"]):
            pass
        with raises_with(WrongChain, code="wrong-chain") as refused:
            async with Node(anvil.url, timing=QUICK, profile=other):
                pass
    assert str(refused.value) == (
        f"the node {anvil.url} is on {profile.title} ({profile.chain_id}), not on {other.title} ({other.chain_id})"
    )
    assert refused.value.hint.endswith(f"or set chain to {profile.name}")


class _Counting(HttpTransport):
    """A node whose questions for one block are counted; it answers those for `lacking` as nodes do without it."""

    def __init__(self, url: str, *, lacking: str = "", answer: Any = None) -> None:
        super().__init__(url)
        self.asked: list[str] = []
        self._lacking, self._answer = lacking, answer

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_getBlockByNumber":
            self.asked.append(params[0])
            if params[0] == self._lacking:
                return {"jsonrpc": "2.0", "id": 1} | (self._answer or {"result": None})
        return await super().make_request(method, params)


@pytest.mark.parametrize("finality", ["safe", "finalized"])
async def test_a_block_counts_when_the_node_says_so(anvil: Anvil, finality: Any) -> None:
    wire = _Counting(anvil.url)
    async with Node(wire, timing=replace(QUICK, finality=finality)) as node:
        await node.request("anvil_mine", "0x14")
        head = (await node.heads.look()).number
        counted = head - BEHIND[finality]
        await until_found(lambda: node.counts(counted), what="the block that is final")
        assert not await node.counts(counted + 1)
        assert await node.counted(head) == counted
        assert await node.counted(counted - 1) == counted - 1, "what was not read yet does not count"
        before = wire.asked.count(finality)
        assert all([await node.counts(counted) for _ in range(50)])
        assert wire.asked.count(finality) == before, "a block that counts is not asked about again"
    await wire.close()


async def test_the_final_block_is_asked_for_the_less_often_the_further_it_is_behind(anvil: Anvil) -> None:
    wire = _Counting(anvil.url)
    async with Node(wire, timing=replace(QUICK, finality="finalized")) as node:
        await node.request("anvil_mine", "0x14", "0x3c")  # a minute each
        await node.heads.look()
        head = await node.block_number()
        await until_found(lambda: node.counts(head - BEHIND["finalized"]), what="the final block")
        before = wire.asked.count("finalized")
        for _ in range(20):
            assert not await node.counts(head)
            await asyncio.sleep(QUICK.poll_interval)
        assert wire.asked.count("finalized") == before, "it changes in minutes"
    await wire.close()


async def test_blocks_count_by_confirmations_without_asking(anvil: Anvil) -> None:
    wire = _Counting(anvil.url)
    async with Node(wire, timing=replace(QUICK, confirmations=3)) as node:
        asked = len(wire.asked)
        assert [await node.counted(10), await node.counted(1)] == [8, -1]
        assert len(wire.asked) == asked
    await wire.close()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ({"result": None}, "it answers none"),
        ({"error": {"code": -39001, "message": "finalized block not found"}}, "finalized block not found"),
        ({"error": {"code": -32602, "message": "hex string without 0x prefix"}}, "hex string without 0x prefix"),
    ],
)
async def test_a_node_that_does_not_say_what_is_final_is_refused_at_the_start(
    anvil: Anvil, answer: dict[str, Any], why: str
) -> None:
    wire = _Counting(anvil.url, lacking="finalized", answer=answer)
    with raises_with(FinalityNotOffered, code="finality-not-offered") as refused:
        async with Node(wire, timing=replace(QUICK, finality="finalized")):
            pass
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)
    async with Node(wire, timing=replace(QUICK, finality="safe")):
        pass
    await wire.close()


class _Pruned(HttpTransport):
    """A node that keeps the state of its latest block only."""

    async def make_request(self, method: str, params: Any) -> Any:
        if method == "eth_call" and params[1] != "latest":
            head = await super().make_request("eth_blockNumber", [])
            if params[1] != head["result"]:
                return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32000, "message": "missing trie node 0badcafe"}}
        return await super().make_request(method, params)


@pytest.mark.parametrize("kind", [HttpTransport, _Pruned])
async def test_who_watches_a_contract_hears_of_its_end_when_that_is_final(
    anvil: Anvil, kind: type[HttpTransport]
) -> None:
    market, wire = await prepare(anvil.url, anvil.private_keys), kind(anvil.url)
    timing = replace(QUICK, finality="finalized")
    async with (
        market.chain(market.provider) as chain,
        Chain(wire, contracts=market.deployment.contracts, timing=timing) as reader,
        asyncio.timeout(60),
    ):
        liability = (await chain.liabilities.create("airalab", market.demand(), market.offer())).liability
        watching = asyncio.create_task(reader.liabilities.watch(liability))
        await chain.liabilities.finalize("airalab", market.result(liability))
        for _ in range(BEHIND["finalized"] - 1):
            await chain.node.request("evm_mine")
            await asyncio.sleep(5 * QUICK.poll_interval)
            assert not watching.done()
        await chain.node.request("anvil_mine", hex(3 * SLOTS))
        await until(watching.done, what="the end is final")
        assert (await watching).is_success
    await wire.close()

"""The counters of a node: transactions by outcome, their cost, failures and outages."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from mesh.chain import XRT, Account, Chain, Node, NodeUnreachable, TransactionSender, deploy
from mesh.chain._pending import TransactionOutcome
from mesh.dev import EmbeddedChain
from mesh.dev._embedded import EmbeddedProvider
from tests.mesh.chain.conftest import QUICK, reverted
from tests.support.chain.senders import anvil, make_too_cheap, open_sender, unused_address

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from typing import Any

    from tests.support.nodes import Anvil

__all__ = ["anvil"]

NONE = {"sent": 0, "replaced": 0, "mined": 0, "failed": 0, "refused": 0, "lost": 0}


class _Line(EmbeddedProvider):
    """A way to an embedded chain that can be cut."""

    cut = False

    async def make_request(self, method: str, params: Any) -> Any:
        if self.cut:
            raise ConnectionResetError("it is cut")
        return await super().make_request(method, params)


@pytest.fixture
async def node() -> AsyncIterator[EmbeddedChain]:
    async with EmbeddedChain() as node:
        yield node


async def test_a_successful_transaction_counts_as_sent_and_mined_with_its_gas(node: EmbeddedChain) -> None:
    async with Node(node.provider, timing=QUICK) as way:
        account = Account(node.funded_keys[0])
        before = await way.eth_balance(account.address)
        receipt = await TransactionSender(way, account).send(to=unused_address(), data=b"", value=5)
        counted = way.sent
        assert counted.by_outcome == NONE | {"sent": 1, "mined": 1}
        assert (counted.gas_used, counted.wei) == (receipt.gas_used, receipt.wei)
        assert before - await way.eth_balance(account.address) == counted.wei + 5


async def test_a_transaction_that_would_revert_is_not_sent_and_costs_nothing(node: EmbeddedChain) -> None:
    deployer, friend = (Account(key) for key in node.funded_keys[:2])
    await deploy(node.provider, deployer)
    async with Chain(node.provider, account=friend, timing=QUICK) as chain:
        with reverted("ERC20InsufficientBalance"):
            await chain.tokens.transfer(deployer.address, XRT)
        counted = chain.node.sent
        assert counted.by_outcome == NONE | {"refused": 1}
        assert (counted.gas_used, counted.wei) == (0, 0)


async def test_an_outage_counts_once_and_each_failed_request(node: EmbeddedChain) -> None:
    line = _Line(node)
    async with Node(line, timing=replace(QUICK, attempts=2)) as way:
        for silence in (1, 2):
            line.cut = True
            for _ in range(3):
                with pytest.raises(NodeUnreachable):
                    await way.block_number()
            counted = way.rpc
            assert (counted.losses, counted.failures) == (silence, 3 * silence)
            line.cut = False
            await way.block_number()
        assert way.rpc.losses == 2


async def test_a_stuck_transaction_is_replaced_and_mined_once(anvil: Anvil) -> None:
    async with open_sender(anvil, replace(QUICK, replace_after=0.1)) as (way, sender):
        sending = asyncio.create_task(sender.send(to=unused_address(), data=b"", value=5))
        await make_too_cheap(way)
        async with asyncio.timeout(60):
            while not sending.done():
                await way.request("evm_mine")
                await asyncio.sleep(0.05)
        await sending
        counted = way.sent.by_outcome
        assert (
            counted[TransactionOutcome.SENT],
            counted[TransactionOutcome.MINED],
            counted[TransactionOutcome.FAILED],
        ) == (1, 1, 0)
        assert counted[TransactionOutcome.REPLACED] >= 1

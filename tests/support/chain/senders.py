"""Senders on an anvil that mines only on request. Opening one sender after another stands for restarts of a process."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from mesh.chain import Account, Node, TransactionSender, new_private_key
from tests.mesh.chain.conftest import QUICK
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.chain import Timing

SHORT = replace(QUICK, receipt_timeout=0.3)
NO_MINING = "--no-mining"


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    """A node that mines only on request (`evm_mine`)."""
    async with Anvil(arguments=(NO_MINING,)) as anvil:
        yield anvil


@asynccontextmanager
async def open_sender(
    anvil: Anvil, timing: Timing = QUICK, **options: Any
) -> AsyncIterator[tuple[Node, TransactionSender]]:
    """A node connection, and a sender for anvil's first account."""
    async with Node(anvil.url, timing=timing, **options) as node:
        yield node, TransactionSender(node, Account(anvil.private_keys[0]))


def unused_address() -> str:
    """An address that nothing was sent to."""
    return Account(new_private_key()).address


async def pending_transactions(node: Node) -> dict[int, Any]:
    """The node's pending transactions, by nonce."""
    senders = (await node.request("txpool_content"))["pending"].values()
    return {int(nonce): sent for by_nonce in senders for nonce, sent in by_nonce.items()}


async def pending_hashes(node: Node) -> dict[int, str]:
    """The hashes of the node's pending transactions, by nonce."""
    return {nonce: sent["hash"] for nonce, sent in (await pending_transactions(node)).items()}


async def until_pending(node: Node, count: int) -> dict[int, str]:
    """The same, once there are `count` of them."""
    async with asyncio.timeout(60):
        while len(found := await pending_hashes(node)) < count:
            await asyncio.sleep(0.01)
    return found


async def make_too_cheap(node: Node) -> tuple[str, int]:
    """Have the next block not take the first pending transaction; its hash, and what it offers.

    Another version of it, which offers more, may come at any time.
    """
    await until_pending(node, 1)
    sent = (await pending_transactions(node))[0]
    offered = int(sent["maxFeePerGas"], 16)
    await node.request("anvil_setNextBlockBaseFeePerGas", hex(offered + 1))
    return sent["hash"], offered

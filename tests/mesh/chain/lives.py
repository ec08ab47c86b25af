"""An account's lives one after the other, on a node that mines when it is told to."""

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
NEVER = "--no-mining"


@pytest.fixture
async def anvil() -> AsyncIterator[Anvil]:
    """A node that mines only when it is told to."""
    async with Anvil(arguments=(NEVER,)) as anvil:
        yield anvil


@asynccontextmanager
async def life(anvil: Anvil, timing: Timing = QUICK, **options: Any) -> AsyncIterator[tuple[Node, TransactionSender]]:
    """One life of a process that sends for anvil's first account."""
    async with Node(anvil.url, timing=timing, **options) as node:
        yield node, TransactionSender(node, Account.from_key(anvil.private_keys[0]))


def stranger() -> str:
    return Account.from_key(new_private_key()).address


async def ask(node: Node, method: str, *params: Any) -> Any:
    return await node.request(method, *params)


async def waiting(node: Node) -> dict[int, str]:
    """The hashes of the node's pending transactions, by number."""
    senders = (await ask(node, "txpool_content"))["pending"].values()
    return {int(number): sent["hash"] for by_number in senders for number, sent in by_number.items()}


async def until_waiting(node: Node, count: int) -> dict[int, str]:
    async with asyncio.timeout(10):
        while len(found := await waiting(node)) < count:
            await asyncio.sleep(0.01)
    return found

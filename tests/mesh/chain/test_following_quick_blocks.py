"""Following a chain of quick blocks, which are glanced at in ranges: what it costs, and that nothing is lost."""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import aclosing, asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

import mesh.chain.following
from mesh.chain import Account, Approval, Chain, deploy
from mesh.chain.following import Reorganisation
from mesh.dev._embedded import EmbeddedChain, EmbeddedProvider
from mesh.settings.chains import CHAINS
from tests.mesh.chain.conftest import QUICK
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from mesh.chain import BlockEvents

FAST = replace(CHAINS["local"], block_seconds=0.2)
TIMING = replace(QUICK, reorg_depth=64)
PER_LOOK = 6
"""New blocks at each look in these tests."""


class Wire(EmbeddedProvider):
    """Counts calls, and leaves the newest `behind` blocks' logs out, as a machine does that is behind.

    Calls for the latest block are not counted: the slower the machine, the more there are.
    """

    behind = 0
    refuses_ranges = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.asked: Counter[str] = Counter()

    async def make_request(self, method: str, params: Any) -> Any:
        if params[:1] != ["latest"]:
            self.asked[method] += 1
        if method == "eth_getLogs" and "fromBlock" in params[0]:
            if self.refuses_ranges:
                return {"jsonrpc": "2.0", "id": 1, "error": {"code": -32005, "message": "range too large"}}
            if self.behind:
                last = int(params[0]["toBlock"], 16) - self.behind
                params = [params[0] | {"toBlock": hex(max(last, int(params[0]["fromBlock"], 16)))}]
        return await super().make_request(method, params)


class Followed:
    """A chain, and what `follow` has yielded of it for the account's own transfers and approvals."""

    def __init__(self, chain: Chain, wire: Wire | None) -> None:
        self.chain = chain
        self.wire = wire
        self.blocks: list[BlockEvents] = []
        self._news = asyncio.Event()

    async def run(self, cursor: int) -> None:
        assert self.chain.account is not None
        async with aclosing(self.chain.follow(cursor, parties=[self.chain.account.address])) as blocks:
            async for block in blocks:
                self.blocks.append(block)
                self._news.set()

    async def until(self, fits: Callable[[], bool]) -> None:
        async with asyncio.timeout(60):
            while not fits():
                self._news.clear()
                await self._news.wait()

    async def mine(self, count: int = PER_LOOK) -> int:
        """Mine blocks at once, and return when they were read."""
        method = "anvil_mine" if self.wire is None else "evm_mine"
        await self.chain.node.request(method, count)
        return await self.read()

    async def read(self) -> int:
        head = await self.chain.block_number()
        await self.until(lambda: bool(self.blocks) and self.blocks[-1].block_number >= head)
        return head

    async def approve(self, value: int) -> int:
        await self.chain.tokens.approve(self.chain.factory, value)
        return await self.chain.block_number()

    @property
    def approved(self) -> list[int]:
        """What was yielded and not reverted."""
        values: list[int] = []
        for block in self.blocks:
            gone = block.reverted_events if isinstance(block, Reorganisation) else ()
            for event in gone:
                assert isinstance(event, Approval)
                assert values.pop() == event.value
            values += [event.value for event in block.events if isinstance(event, Approval)]
        return values


@asynccontextmanager
async def following(chain: Chain, wire: Wire | None) -> AsyncIterator[Followed]:
    followed = Followed(chain, wire)
    async with asyncio.TaskGroup() as tasks:
        task = tasks.create_task(followed.run(await chain.block_number() + 1))
        await asyncio.sleep(0)
        for _ in range(2):  # the first blocks are read one by one
            await followed.mine()
        yield followed
        task.cancel()


@pytest.fixture
async def followed() -> AsyncIterator[Followed]:
    async with EmbeddedChain() as node:
        account = Account(node.funded_keys[0])
        await deploy(node.provider, account)
        wire = Wire(node)
        async with Chain(wire, account=account, timing=TIMING, profile=FAST) as chain, following(chain, wire) as one:
            yield one


async def test_idle_blocks_are_read_in_few_calls_whatever_their_number(followed: Followed) -> None:
    assert followed.wire is not None
    await followed.mine()
    followed.wire.asked.clear()
    for _ in range(5):
        await followed.mine(20)
    asked = followed.wire.asked
    assert asked["eth_getLogs"] <= 3 * 6, asked
    assert asked["eth_getBlockByNumber"] < 40, "a header for each block would be a hundred"


async def test_events_are_yielded_once_in_their_blocks(followed: Followed) -> None:
    heads = []
    for value in (3, 4, 5):
        heads.append(await followed.approve(value))
        await followed.mine()
    assert followed.approved == [3, 4, 5]
    yielded = [block.block_number for block in followed.blocks if block.events]
    assert yielded == heads
    assert not any(isinstance(block, Reorganisation) for block in followed.blocks)


async def test_a_log_that_a_machine_left_out_is_yielded_when_another_one_has_it(followed: Followed) -> None:
    assert followed.wire is not None
    followed.wire.behind = 2 * PER_LOOK
    await followed.approve(7)
    await followed.mine()
    assert followed.approved == [], "the machine that answers lacks it"
    followed.wire.behind = 0
    await followed.mine()
    assert followed.approved == [7]
    late = next(block for block in followed.blocks if isinstance(block, Reorganisation))
    assert late.reverted_events == ()
    await followed.mine()
    assert followed.approved == [7]


async def test_a_machine_that_is_behind_takes_nothing_back(followed: Followed) -> None:
    assert followed.wire is not None
    await followed.approve(8)
    await followed.mine()
    followed.wire.behind = 3 * PER_LOOK
    for _ in range(3):
        await followed.mine()
    assert followed.approved == [8]
    assert not any(isinstance(block, Reorganisation) for block in followed.blocks)


async def test_a_node_that_refuses_ranges_is_read_block_by_block(followed: Followed) -> None:
    assert followed.wire is not None
    followed.wire.refuses_ranges = True
    await followed.approve(9)
    for _ in range(2):
        await followed.mine()
    assert followed.approved == [9]


async def test_an_event_of_a_replaced_block_is_reverted_at_the_next_look(monkeypatch: pytest.MonkeyPatch) -> None:
    pace = mesh.chain.following.FOLLOW_PACE._replace(replaced=float("inf"))
    monkeypatch.setattr(mesh.chain.following, "FOLLOW_PACE", pace)
    with Anvil() as anvil:
        account = Account(anvil.private_keys[0])
        await deploy(anvil.url, account)
        async with (
            Chain(anvil.url, account=account, timing=TIMING, profile=FAST) as chain,
            following(chain, None) as followed,
        ):
            await followed.approve(3)
            await followed.mine()
            await followed.approve(4)
            await followed.mine()
            assert followed.approved == [3, 4]
            await chain.node.request("anvil_reorg", PER_LOOK + 2, [])
            await followed.mine()
            await followed.until(lambda: followed.approved == [3])
            await followed.approve(5)
            await followed.mine()
            assert followed.approved == [3, 5]

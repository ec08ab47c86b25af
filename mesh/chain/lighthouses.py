"""Markets and those who work for them: the parts of `Chain` that make lighthouses and stake on them."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING

from mesh.chain.errors import InsufficientTokens, StakeTooSmall
from mesh.chain.events import NewLighthouse, lighthouse_created
from mesh.chain.following import Following
from mesh.chain.tokens import Tokens

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from mesh.chain.records import LighthouseState


class Lighthouses(Following, Tokens):
    """Lighthouses, stakes and turns; a part of `Chain`."""

    async def is_lighthouse(self, address: str) -> bool:
        """Whether the factory made the lighthouse at an address."""
        return bool(await self.node.read(self._factory_contract().functions.isLighthouse(await self.resolve(address))))

    async def lighthouse(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse: stakes, turn, quota."""
        return await self._suite.state(await self.lighthouse_address(lighthouse))

    async def is_turn(self, lighthouse: str, address: str | None = None) -> bool:
        """Whether a provider (one's own account by default) may send to a lighthouse in the next block."""
        return await self._suite.is_turn(await self.lighthouse_address(lighthouse), await self._whose(address))

    async def lighthouses(self, *, from_block: int = 0) -> list[NewLighthouse]:
        """All lighthouses made since a block, in order."""
        return [made async for made in self._made(from_block) if isinstance(made, NewLighthouse)]

    async def watch_lighthouses(self, from_block: int | None = None) -> AsyncGenerator[NewLighthouse, None]:
        """Each lighthouse made from a block on (by default from the next), for ever and each once.

        A lighthouse that a reorganisation takes back stays told. A node that is lost meanwhile is waited for; only
        when there is none at the start, `NodeUnreachable` is raised.
        """
        cursor = await self.block_number() + 1 if from_block is None else from_block
        told: set[str] = set()
        async with aclosing(self._follow_made(cursor)) as following:
            async for made in following:
                if isinstance(made, NewLighthouse) and made.lighthouse not in told:
                    told.add(made.lighthouse)
                    yield made

    async def create_lighthouse(self, *, minimal_stake: int, timeout_blocks: int, name: str) -> NewLighthouse:
        """Make a market. `minimal_stake` in wn; `name` is one label of a to z, 0 to 9 and -."""
        function = self._factory_contract().functions.createLighthouse
        return lighthouse_created((await self._send(function(minimal_stake, timeout_blocks, name))).logs)

    async def become_provider(self, lighthouse: str, stake: int) -> LighthouseState:
        """Have at least `stake` wn staked on a lighthouse, all told; its state then.

        Only what is missing is approved, and only what is missing is staked: called again after it was broken off
        anywhere, it goes on from there. Raises `StakeTooSmall` and `InsufficientTokens` before anything is sent.
        """
        me = self._signing().account.address
        address = await self.lighthouse_address(lighthouse)
        # In this order: a stake on its way may be mined between the two, and takes its allowance with it.
        allowance = await self.allowance(me, address)
        state = await self._suite.state(address)
        missing = stake - state.stakes.get(me, 0)
        if missing <= 0:
            return state
        if stake < state.minimal_stake:
            raise StakeTooSmall(stake, state.minimal_stake)
        balance = await self.balance_of(me)
        if balance < missing:
            raise InsufficientTokens(me, self.xrt, balance=balance, needed=missing)
        if allowance < missing:
            await self.approve(address, missing)
        await self.refill(address, missing)
        return await self._suite.state(address)

    async def refill(self, lighthouse: str, value: int) -> str:
        """Stake `value` wn, for which the lighthouse must be approved, and become a provider; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.refill(value))).tx

    async def withdraw(self, lighthouse: str, value: int) -> str:
        """Take `value` wn off the stake, or all of it where less than the minimum would remain; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.withdraw(value))).tx

"""When a provider may send transactions to its lighthouse, and how many."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.chain import Chain, LighthouseState


class NoStake(ChainError, code="no-stake"):
    """A provider has no stake at its lighthouse, which refuses all its transactions. The minimal stake is in wn."""

    def __init__(self, provider: str, lighthouse: str, *, minimal_stake: int) -> None:
        super().__init__(
            f"{provider} has no stake at the lighthouse {lighthouse}",
            hint=f"stake {minimal_stake} wn or more: `aira lighthouse join {minimal_stake}wn`",
        )
        self.provider = provider
        self.lighthouse = lighthouse
        self.minimal_stake = minimal_stake


class Turns:
    """The turns of the chain's account at `lighthouse` (address), with at most `most` transactions under way.

    Methods raise `NodeUnreachable`, `RequestRefused`.

    The contract lets other providers send after a timeout without transactions. But there may have been nothing to
    send: if all providers sent the next job's transactions at once, all but one would pay for a refusal. So a provider
    whose turn it is not waits, from when it had work, so that those before it have their time. It counts mined blocks
    only, as a transaction of another provider may be mined after one that is sent now.

    What the lighthouse says is of the last block. So it is asked only while no transaction is under way, and no more
    are sent than it says are left. One provider alone has a new turn after each: it has no quota, unless somebody
    comes.
    """

    def __init__(self, chain: Chain, lighthouse: str, *, most: int = 1) -> None:
        assert chain.account is not None
        self._chain = chain
        self._lighthouse = lighthouse
        self._provider = chain.account.address
        self._most = most
        self._left = 0
        self._under_way = 0
        self._ended = asyncio.Event()

    async def has_come(self, *, since: int) -> bool:
        """Whether the account may send now a transaction that it has had since block `since`. Raises `NoStake`."""
        if self._left > 0 or self._under_way:
            return self._left > 0
        state = await self._chain.lighthouses.get(self._lighthouse)
        if self._provider not in state.stakes:
            raise NoStake(self._provider, self._lighthouse, minimal_stake=state.minimal_stake)
        if state.current == self._provider:
            self._left = state.quota if len(state.stakes) > 1 else max(state.quota, self._most)
        elif await self._chain.lighthouses.is_turn(self._lighthouse) and await self._is_left_to_us(state, since):
            self._left = 1
        return self._left > 0

    def take_one(self) -> None:
        """Count a transaction of the account that is sent now."""
        self._left -= 1
        self._under_way += 1

    def ended(self) -> None:
        """Count the end of such a transaction: it was mined, or failed, or its outcome is unknown."""
        self._under_way -= 1
        self._ended.set()

    async def one_ended(self) -> bool:
        """Wait for the end of a transaction under way; False if there is none."""
        if not self._under_way:
            return False
        self._ended.clear()
        return await self._ended.wait()

    def forget(self) -> None:
        """Ask the lighthouse again before the next transaction."""
        self._left = 0

    async def _is_left_to_us(self, state: LighthouseState, since: int) -> bool:
        """Whether the providers before this one had their time: the first two a timeout each, the others a block."""
        providers = list(state.stakes)
        before = (providers.index(self._provider) - providers.index(state.current)) % len(providers)
        # After two timeouts the contract lets all of them send. Those far behind don't wait for each silent one.
        behind = min(max(before - 2, 0), state.timeout_blocks)
        return await self._chain.block_number() - since >= min(before, 2) * state.timeout_blocks + behind

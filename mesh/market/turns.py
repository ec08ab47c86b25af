"""Whose turn it is at a lighthouse, as one of its providers has to see it.

The contract lets others in after a timeout of silence. But silence also means that there was nothing to do: after it,
all providers would send the next job's transactions at once, and all but one pay for a refusal. So a provider that is
not on turn waits until it had work for as many timeouts as there are turns before its own. And it goes by blocks that
are mined: what another provider has sent may come after what is sent now.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.chain import Chain, LighthouseState


class NoStake(ChainError):
    """A provider has staked nothing at its lighthouse, which takes no transaction of it."""

    code = "no-stake"

    def __init__(self, provider: str, lighthouse: str, *, minimal_stake: int) -> None:
        super().__init__(
            f"{provider} has no stake at the lighthouse {lighthouse}",
            hint=f"stake {minimal_stake} wn or more: `aira lighthouse join {minimal_stake}wn`",
        )
        self.provider = provider
        self.lighthouse = lighthouse
        self.minimal_stake = minimal_stake


class Turns:
    """The turns of the chain's account at `lighthouse` (address). Methods raise `NodeUnreachable`, `RequestRefused`."""

    def __init__(self, chain: Chain, lighthouse: str, provider: str) -> None:
        self._chain = chain
        self._lighthouse = lighthouse
        self._provider = provider
        self._left = 0

    async def has_come(self, *, since: int) -> bool:
        """Whether the next transaction is ours to send, for work that was there at block `since`.

        Raises `NoStake`.
        """
        if self._left > 0:
            return True
        state = await self._chain.lighthouses.get(self._lighthouse)
        if self._provider not in state.stakes:
            raise NoStake(self._provider, self._lighthouse, minimal_stake=state.minimal_stake)
        if state.current == self._provider:
            self._left = state.quota
            return True
        return await self._chain.lighthouses.is_turn(self._lighthouse) and await self._is_left_to_us(state, since)

    def took_one(self) -> None:
        """A transaction of ours was mined."""
        self._left -= 1

    def forget(self) -> None:
        """Ask the lighthouse anew before the next transaction."""
        self._left = 0

    async def _is_left_to_us(self, state: LighthouseState, since: int) -> bool:
        """Whether those before us had their time for what there is to do."""
        providers = list(state.stakes)
        before = (providers.index(self._provider) - providers.index(state.current)) % len(providers)
        return await self._chain.block_number() - since >= before * state.timeout_blocks

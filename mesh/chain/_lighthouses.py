"""Lighthouses: creating them, reading their state, staking. `chain.lighthouses`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.chain._tokens import Tokens
from mesh.chain.errors import InsufficientTokens
from mesh.chain.following import NewLighthouse, first_event, list_created
from mesh.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mesh.chain._contracts import Contracts, LighthouseState


class Lighthouses:
    """Lighthouses, stakes and turns. A lighthouse is given by its ENS name, its label or its address."""

    def __init__(self, contracts: Contracts) -> None:
        self._contracts = contracts
        self._tokens = Tokens(contracts)

    async def exists(self, address: str) -> bool:
        """Whether the factory created the lighthouse at an address."""
        is_lighthouse = self._contracts.factory_contract().isLighthouse
        return bool(await self._contracts.node.read(is_lighthouse(await self._contracts.names.address(address))))

    async def get(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse: stakes, turn, quota."""
        return await self._contracts.version.state(await self._contracts.names.lighthouse(lighthouse))

    async def is_turn(self, lighthouse: str, address: str | None = None) -> bool:
        """Whether a provider (one's own account by default) may send to a lighthouse in the next block."""
        return await self._contracts.version.is_turn(
            await self._contracts.names.lighthouse(lighthouse), await self._contracts.address_or_own(address)
        )

    async def list(self, *, from_block: int = 0) -> Sequence[NewLighthouse]:
        """All lighthouses created since a block, in order."""
        created = await list_created(self._contracts.node, self._contracts.factory, from_block)
        return [event for event in created if isinstance(event, NewLighthouse)]

    async def create(self, *, minimal_stake: int, timeout_blocks: int, name: str) -> NewLighthouse:
        """Create a lighthouse. `minimal_stake` is in wn; `name` is one label of ENS, of a to z, 0 to 9 and -."""
        function = self._contracts.factory_contract().createLighthouse
        receipt = await self._contracts.send(function(minimal_stake, timeout_blocks, name))
        return first_event(receipt.logs, NewLighthouse)

    async def become_provider(self, lighthouse: str, stake: int) -> LighthouseState:
        """Raise one's stake on a lighthouse to at least `stake` wn; its state then.

        Only what is missing is approved and staked, so that it can be called again after an interruption.
        Raises `InputError` (`stake-too-small`) and `InsufficientTokens` before anything is sent.
        """
        me = self._contracts.own_address
        address = await self._contracts.names.lighthouse(lighthouse)
        # In this order: a pending stake may be mined in between, and uses up its allowance.
        allowance = await self._tokens.allowance(me, address)
        state = await self._contracts.version.state(address)
        missing = stake - state.stakes.get(me, 0)
        if missing <= 0:
            return state
        if stake < state.minimal_stake:
            least = state.minimal_stake
            raise InputError(
                f"a stake of {stake} wn is below the lighthouse's minimum of {least} wn",
                hint=f"stake {least} wn or more: each such amount is one transaction a turn",
                code="stake-too-small",
            )
        balance = await self._tokens.balance(me)
        if balance < missing:
            raise InsufficientTokens(me, self._contracts.xrt, balance=balance, needed=missing)
        if allowance < missing:
            await self._tokens.approve(address, missing)
        await self.refill(address, missing)
        return await self._contracts.version.state(address)

    async def refill(self, lighthouse: str, value: int) -> str:
        """Stake `value` wn, which the lighthouse must be allowed to take, and become a provider; the tx hash."""
        return (await self._contracts.send((await self._contracts.lighthouse_contract(lighthouse)).refill(value))).tx

    async def withdraw(self, lighthouse: str, value: int) -> str:
        """Withdraw `value` wn of the stake, or all of it if less than the minimum would remain; the tx hash."""
        return (await self._contracts.send((await self._contracts.lighthouse_contract(lighthouse)).withdraw(value))).tx

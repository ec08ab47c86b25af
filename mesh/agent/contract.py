"""A contract (liability) whose end is waited for."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec

from mesh.content import ContentUnavailable

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.components import AgentComponents
    from schemas import Liability


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """How a contract ended: `success` means that the promisor was paid; `result` is the recording's CID, or empty."""

    success: bool
    result: str


class Contract:
    """A contract on the chain: `await contract.outcome()`, then `await contract.recording()`."""

    def __init__(self, liability: Liability, ended: asyncio.Future[Outcome], parts: AgentComponents) -> None:
        self.liability = liability
        """Its record, as it was when the contract was first read."""
        self._ended = ended
        self._parts = parts

    @property
    def address(self) -> str:
        """The contract's address (EIP-55)."""
        return self.liability.address

    async def outcome(self) -> Outcome:
        """Wait until the contract is finalized. Cancelling the wait changes nothing.

        Raises `ClosedError` if the agent ends first, and `LiabilityReverted` if a reorganisation reverted the contract
        and it was not created again by its orders' deadline.
        """
        return await asyncio.shield(self._ended)

    async def recording(self) -> Path:
        """Wait for the outcome, and fetch the result's recording, every block of it checked.

        Raises a `ContentError` if the recording is unavailable or the contract was refunded without a result.
        """
        outcome = await self.outcome()
        if not outcome.result:
            raise ContentUnavailable("the recording", f"contract {self.address} was refunded without a result")
        settings = self._parts.settings
        return await self._parts.exchange.fetch(
            outcome.result, size_limit=settings.objective_expanded_limit, timeout=settings.fetch_timeout
        )

"""A liability, from the side of one who waits for its end."""

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
    """A contract of the chain: `await contract.outcome()`, then `await contract.recording()`."""

    def __init__(self, liability: Liability, ended: asyncio.Future[Outcome], parts: AgentComponents) -> None:
        self.liability = liability
        """Its terms, as they were when the contract was first seen."""
        self._ended = ended
        self._parts = parts

    @property
    def address(self) -> str:
        """The contract's address (EIP-55)."""
        return self.liability.address

    async def outcome(self) -> Outcome:
        """Wait until the chain has finalized the contract. Cancelling the wait changes nothing.

        Raises `ClosedError` when the agent ends before the contract does, and `LiabilityReverted` when the chain has
        taken it back and it was not made again in time.
        """
        return await asyncio.shield(self._ended)

    async def recording(self) -> Path:
        """The result's file: waits for the outcome, fetches the recording by its CID and checks every block.

        Raises a `ContentError` when nobody holds it, or the contract was refunded without a result.
        """
        outcome = await self.outcome()
        if not outcome.result:
            raise ContentUnavailable("the recording", f"contract {self.address} was refunded without a result")
        settings = self._parts.settings
        return await self._parts.exchange.fetch(
            outcome.result, size_limit=settings.objective_expanded_limit, timeout=settings.fetch_timeout
        )

"""Health and metrics of a chain that this process serves."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.chain import NodeUnreachable, RequestRefused
from mesh.telemetry.metrics import MetricFamily, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain import Node

INTERVAL: Final = 1.0
"""Seconds between two checks."""


class ChainMonitor:
    """Checks the chain of an open `node` regularly while `run` runs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._head: int | None = None

    async def run(self) -> None:
        """Check until cancelled."""
        while True:
            try:
                self._head = await self._node.block_number()
            except (NodeUnreachable, RequestRefused):
                self._head = None
            await asyncio.sleep(INTERVAL)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The number of the latest block; nothing while the chain does not answer."""
        if self._head is None:
            return ()
        return (gauge("aira_chain_head_block", "The last block that was read", self._head),)

    def health(self) -> Mapping[str, str]:
        """Whether the chain answers."""
        return {"chain": "does not answer" if self._head is None else ALIVE}

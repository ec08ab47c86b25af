"""A look at a served chain now and then, for an operator: whether it answers, and how high it is."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.chain import NodeUnreachable, RequestRefused
from mesh.telemetry.metrics import MetricFamily, gauge
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain import Node

LOOK: Final = 1.0
"""Seconds between two looks."""


class Look:
    """Looks at the chain of `node`, which is open, while it runs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._head: int | None = None

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            try:
                self._head = await self._node.block_number()
            except (NodeUnreachable, RequestRefused):
                self._head = None
            await asyncio.sleep(LOOK)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """How high the chain is, if that is known."""
        return (
            () if self._head is None else (gauge("aira_chain_head_block", "The last block that was read", self._head),)
        )

    def health(self) -> Mapping[str, str]:
        """Whether the chain answers."""
        return {"chain": "does not answer" if self._head is None else ALIVE}

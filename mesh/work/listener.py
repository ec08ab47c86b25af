"""The listener: reads the chain block by block and tells the agent of liabilities that concern it."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, Protocol

from mesh.chain import Finalized, NewLiability, NodeUnreachable, RequestRefused

if TYPE_CHECKING:
    from mesh.chain import Chain
    from mesh.work.ledger import Ledger
    from schemas import Liability

log = logging.getLogger(__name__)

RETRY: Final = 1.0
"""Seconds before a node is asked again that was lost, or that refused to answer."""


class Party(Protocol):
    """Who a listener reads for."""

    async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was made that names this account as promisor or promisee (or both)."""

    async def finalized(self, address: str, *, success: bool, result: str) -> None:
        """The contract at `address`, perhaps none of ours, has paid (`success`) or refunded; `result` is its CID."""

    async def new_head(self, block: int) -> None:
        """All of `block` has been handled."""


class Listener:
    """Reads from the block after the ledger's cursor, so that nothing is missed while the agent is down.

    An agent that never ran begins at the head. A block is handled again after a crash in its middle: what a `Party`
    does must bear that.
    """

    NAME = "listener"

    def __init__(self, chain: Chain, ledger: Ledger, account: str, party: Party) -> None:
        self._chain = chain
        self._ledger = ledger
        self._account = account
        self._party = party
        self._lost = False

    async def run(self) -> None:
        """Read until cancelled. A node that can't be reached is waited for. Raises `ChainWentBack`."""
        while True:
            try:
                await self._read()
            except (NodeUnreachable, RequestRefused) as error:
                if not self._lost:
                    log.warning("the chain can't be read, trying again: %s", error)
                self._lost = True
                await asyncio.sleep(RETRY)

    async def _read(self) -> None:
        """Read from the ledger's cursor on."""
        cursor = await self._ledger.cursor(self.NAME)
        if cursor is None:
            cursor = await self._chain.block_number()
            await self._ledger.set_cursor(self.NAME, cursor)
        async for block in self._chain.events(cursor + 1):
            if self._lost:
                log.info("the chain can be read again, from block %d", block.block_number)
            self._lost = False
            for event in block.events:
                match event:
                    case NewLiability():
                        await self._new_liability(event)
                    case Finalized():
                        await self._party.finalized(event.liability, success=event.success, result=event.result)
            await self._ledger.set_cursor(self.NAME, block.block_number)
            await self._party.new_head(block.block_number)

    async def _new_liability(self, event: NewLiability) -> None:
        liability = await self._chain.liability(event.liability)
        if self._account in (liability.promisor, liability.promisee):
            demand_hash, offer_hash = await self._chain.order_hashes(event.liability)
            await self._party.new_liability(liability, demand_hash=demand_hash, offer_hash=offer_hash)

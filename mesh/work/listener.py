"""The listener: reads the chain block by block and tells the agent of liabilities that concern it."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from typing import TYPE_CHECKING, Final, Protocol

from mesh.chain import (
    Approval,
    Finalized,
    History,
    NewLiability,
    NoContracts,
    NodeUnreachable,
    NotALiability,
    Reorganisation,
    RequestRefused,
    Transfer,
)
from mesh.outage_log import OutageLog
from mesh.telemetry.context import liability_context

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mesh.chain import Chain, ChainEvent
    from mesh.work.ledger import Ledger
    from schemas import Liability

log = logging.getLogger(__name__)

RETRY: Final = 1.0
"""Seconds before a node is asked again that was lost, or that refused to answer."""


class ChainEventHandler(Protocol):
    """Who a listener reads for."""

    async def new_liability(self, liability: Liability, *, demand_hash: bytes, offer_hash: bytes) -> None:
        """A contract was made that names this account as promisor or promisee (or both)."""

    async def finalized(self, address: str, *, success: bool, result: str) -> None:
        """The contract at `address`, perhaps none of ours, has paid (`success`) or refunded; `result` is its CID."""

    async def taken_back(self, address: str) -> None:
        """The chain was reorganised: that the contract at `address` has ended did not happen, or not yet."""

    async def unmade(self, address: str) -> None:
        """The chain was reorganised: there is no contract at `address`, or not yet."""

    async def token_event(self, event: Transfer | Approval) -> None:
        """Tokens changed hands, or may be taken by somebody; perhaps none of this account's."""

    async def token_event_taken_back(self, event: Transfer | Approval) -> None:
        """The chain was reorganised: that did not happen, or not yet."""

    async def new_head(self, block: int) -> None:
        """All of `block` has been handled; after a reorganisation it may be lower than before."""


class Listener:
    """Reads from the block after the ledger's cursor, so that nothing is missed while the agent is down.

    An agent that never ran begins at the head. A block is handled again after a crash in its middle: handling is
    idempotent. Token events are those of `token` (name or address), XRT by default.
    """

    NAME = "listener"

    def __init__(
        self, chain: Chain, ledger: Ledger, account: str, party: ChainEventHandler, *, token: str = ""
    ) -> None:
        self._chain = chain
        self._ledger = ledger
        self._account = account
        self._party = party
        self._token = token
        self._trouble = OutageLog(log, "chain")

    async def run(self) -> None:
        """Read until cancelled. A node that can't be reached is waited for. Raises `ChainWentBack`, `UnknownName`."""
        while True:
            try:
                await self._read()
            except (NodeUnreachable, RequestRefused, NoContracts) as error:
                # The last of a contract whose block was replaced, or of a node that is behind the one that told of it.
                self._trouble.failed(error, "the chain can't be read, trying again")
                await asyncio.sleep(RETRY)

    @property
    def waits(self) -> bool:
        """Whether the chain can't be read just now."""
        return self._trouble.is_down

    async def _read(self) -> None:
        """Read from the ledger's cursor on."""
        token = await self._chain.names.address(self._token) if self._token else ""
        cursor, history = await self._memory()
        async with aclosing(
            self._chain.follow(cursor + 1, token=token, history=history, outages=self._trouble)
        ) as blocks:
            async for block in blocks:
                self._trouble.recovered(f"the chain can be read again, from block {block.block_number}")
                if isinstance(block, Reorganisation):
                    await self._take_back(block)
                await self._handle(block.events)
                await self._ledger.set_cursor(self.NAME, block.block_number, history=history.encode())
                await self._party.new_head(block.block_number)

    async def _memory(self) -> tuple[int, History]:
        """The last block that was handled, and what is remembered of those before it."""
        depth = self._chain.node.timing.reorg_depth
        cursor = await self._ledger.cursor(self.NAME)
        if cursor is None:
            cursor = await self._chain.block_number()
            await self._ledger.set_cursor(self.NAME, cursor)
        remembered = await self._ledger.history(self.NAME)
        history = History.decode(remembered) if remembered else History(depth)
        history.depth = depth  # which may have been set otherwise since
        return cursor, history

    async def _handle(self, events: Iterable[ChainEvent]) -> None:
        for event in events:
            match event:
                case NewLiability():
                    await self._new_liability(event)
                case Finalized():
                    await self._party.finalized(event.liability, success=event.success, result=event.result)
                case Transfer() | Approval():
                    await self._party.token_event(event)

    async def _new_liability(self, event: NewLiability) -> None:
        try:
            liability = await self._chain.liabilities.get(event.liability)
        except NotALiability as error:
            with liability_context(event.liability):
                log.warning("a reorganisation was quicker: %s", error)
            return
        if self._account in (liability.promisor, liability.promisee):
            demand_hash, offer_hash = await self._chain.liabilities.order_hashes(event.liability)
            await self._party.new_liability(liability, demand_hash=demand_hash, offer_hash=offer_hash)

    async def _take_back(self, block: Reorganisation) -> None:
        """The chain replaced blocks: what was told of them did not happen, unless the new blocks say so again."""
        log.warning("the chain replaced all after block %d", block.block_number)
        for event in block.reverted_events:
            match event:
                case NewLiability():
                    await self._party.unmade(event.liability)
                case Finalized():
                    await self._party.taken_back(event.liability)
                case Transfer() | Approval():
                    await self._party.token_event_taken_back(event)

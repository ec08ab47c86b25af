"""What happens on the chain, as it happens: the parts of `Chain` that read events."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING

from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.chain.events import NewLiability, NewLighthouse
from mesh.chain.history import History
from mesh.chain.opening import OpenChain
from mesh.chain.reader import BlockEvents, Sources, read_blocks, read_made, read_once, read_range
from mesh.trouble import Trouble

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterable

log = logging.getLogger(__name__)


class Following(OpenChain):
    """Events; a part of `Chain`."""

    def events(
        self, from_block: int, *, lighthouses: Iterable[str] = (), token: str = "", history: History | None = None
    ) -> AsyncGenerator[BlockEvents, None]:
        """Events from a block on, for ever (see `read_blocks`); those of lighthouses only of the given addresses.

        Transfers and approvals are those of the token at the address `token`, XRT by default. Blocks that the chain
        replaced are told as `Reorganised`, also from before where the `history` is given that an earlier iterator
        filled.
        """
        sources = Sources(
            factory=self.factory,
            token=token or self.xrt,
            lighthouses=tuple(lighthouses),
            is_liability=self.is_liability,
            recognise=self._suite.recognise,
        )
        return read_blocks(self.node, partial(read_range, self.node, sources), from_block, history=history)

    async def is_liability(self, address: str) -> bool:
        """Whether the factory made the contract at an address."""
        return await self._suite.is_liability(address)

    async def _made(self, from_block: int) -> AsyncGenerator[NewLiability | NewLighthouse, None]:
        """What the factory made from a block to the latest one, in order."""
        blocks = read_once(self.node, partial(read_made, self.node, self.factory), from_block)
        async with aclosing(blocks):
            async for block in blocks:
                for event in block.events:
                    if isinstance(event, NewLiability | NewLighthouse):
                        yield event

    async def _follow_made(self, cursor: int) -> AsyncGenerator[NewLiability | NewLighthouse, None]:
        """What the factory makes from a block on, for ever; a node that is lost is waited for."""
        history, trouble = History(self.node.timing.reorg_depth), Trouble(log)
        read = partial(read_made, self.node, self.factory)
        while True:
            try:
                async with aclosing(read_blocks(self.node, read, cursor, history=history)) as blocks:
                    async for block in blocks:
                        trouble.over(f"the chain can be read again, from block {block.block_number}")
                        for event in block.events:
                            if isinstance(event, NewLiability | NewLighthouse):
                                yield event
                        cursor = block.block_number + 1
            except (NodeUnreachable, RequestRefused) as error:
                trouble.met(error, "the chain can't be read, trying again")
            await asyncio.sleep(self.node.timing.poll_interval)

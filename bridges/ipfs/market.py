"""What the chain says of the markets whose messages cross. Its node may come later, and come back."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from mesh.errors import ChainError

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from mesh.chain import Chain

log = logging.getLogger(__name__)

AGAIN: Final = 5.0
"""Seconds between two attempts to reach a node that is not there."""


class ChainAwaited(ChainError):
    """The chain's node was not reached yet."""

    code = "chain-awaited"


class Markets:
    """The addresses of `lighthouses` (ENS names), other names, and the latest block: `await markets.run()`.

    `chain` makes a client that is not open yet. Until its node is there nothing is known, which is said once; what was
    known once stays known. `interval` is in seconds, between two looks at the latest block, `again` between two
    attempts to reach the node.
    """

    def __init__(
        self,
        chain: Callable[[], AbstractAsyncContextManager[Chain]],
        lighthouses: tuple[str, ...],
        *,
        interval: float,
        again: float = AGAIN,
    ) -> None:
        self._make = chain
        self._interval = interval
        self._again = again
        self._chain: Chain | None = None
        self._addresses: dict[str, str | None] = dict.fromkeys(lighthouses)
        self.head = 0
        """The latest block; 0 before it was first known."""
        self.error = ""
        """What is wrong with the chain just now."""

    def address(self, lighthouse: str) -> str | None:
        """The lighthouse's address, as soon as it is known."""
        return self._addresses[lighthouse]

    async def resolve(self, name: str) -> str:
        """The address behind an ENS name. Raises `ChainError`."""
        if self._chain is None:
            raise ChainAwaited("the chain's node is not there yet")
        return await self._chain.names.address(name)

    async def run(self) -> None:
        """Follow the chain until cancelled. Raises `ConfigurationError` for a chain that can't be the right one."""
        while True:
            try:
                async with self._make() as self._chain:
                    log.info("the chain is there: deadlines and names are checked")
                    while True:
                        await self._look(self._chain)
                        await asyncio.sleep(self._interval)
            except ChainError as error:
                self._say(error, "deadlines and names are not checked until the chain's node is there")
            finally:
                self._chain = None
            await asyncio.sleep(self._again)

    async def _look(self, chain: Chain) -> None:
        """Read what is not known. A node that went away stays ours: its client finds it again."""
        try:
            self.head = await chain.block_number()
            for name in [name for name, address in self._addresses.items() if address is None]:
                self._addresses[name] = await chain.names.address(name)
            self.error = ""
        except ChainError as error:
            self._say(error, "the latest block, or a lighthouse's address, is not known")

    def _say(self, error: ChainError, meaning: str) -> None:
        if str(error) != self.error:
            log.warning("%s: %s", meaning, error)
        self.error = str(error)

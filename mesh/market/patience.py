"""How long a provider tries a transaction that fails for what passes, or for what is the transaction's own fault.

The two can't be told apart by one failure: a node that is asked too much refuses anything, and a token can keep a node
busy for longer than anybody waits, or speak with the lighthouse's words. So such a transaction is tried again, but
neither for ever nor for much of the time that others wait for.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final, TypeVar

from mesh.chain import NodeUnreachable, RequestRefused, Reverted

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

T = TypeVar("T")

TRIES: Final = 8
"""How often a transaction is tried."""
PAUSE: Final = 1.0
"""Seconds before the second try; doubled before each further one."""
LONGEST_PAUSE: Final = 60.0
BUSY: Final = 100.0
"""Seconds that failing tries may take in all: all others wait meanwhile."""
OUT_OF_TURN: Final = frozenset({"NotYourTurn", "NotAProvider"})
"""What the lighthouse says to a provider, whatever the transaction is."""


def may_pass(error: NodeUnreachable | RequestRefused | Reverted) -> bool:
    """Whether a failure may have nothing to do with the transaction that it befell."""
    return not isinstance(error, Reverted) or error.reason in OUT_OF_TURN


class Patience:
    """The patience with one transaction."""

    def __init__(self) -> None:
        self._tries = 0
        self._busy = 0.0

    async def attempt(self, transaction: Callable[[], Awaitable[T]]) -> T:
        """What `transaction` returns. Raises what it raises; how long a failure took is counted."""
        loop = asyncio.get_running_loop()
        begun = loop.time()
        try:
            return await transaction()
        except (NodeUnreachable, RequestRefused):
            self._busy += loop.time() - begun
            raise

    def pause(self) -> float | None:
        """Seconds until the transaction that failed is to be tried again; None when it had its chances."""
        self._tries += 1
        if self._tries >= TRIES or self._busy >= BUSY:
            return None
        return min(PAUSE * 2.0 ** (self._tries - 1), LONGEST_PAUSE)

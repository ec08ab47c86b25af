"""Descriptions of models: from the store, or from peers that serve them now."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.flood import BoundedDict
from mesh.base.retry import RetryPolicy
from mesh.errors import ContentError
from schemas.model import DESCRIPTION_LIMITS, ModelDescription, is_description, read_description

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.base.clock import Clock
    from mesh.content import Exchange, Store


PATIENCE: Final = 3.0
"""Seconds that others have to say that they have a model; if all say at once that they don't, it takes no time."""
ABSENT: Final = RetryPolicy(initial=10.0, ceiling=300.0, jitter=0.0)
"""How long what nobody had is not looked for again, by how often it was absent."""


class Absences:
    """CIDs that nobody had, which are not looked for again for a while, the longer the more often that was so."""

    def __init__(self, kept: int, clock: Clock) -> None:
        self._clock = clock
        self._known: BoundedDict[str, tuple[int, float]] = BoundedDict(kept)
        """How often a CID was absent, and until when it is not looked for."""

    def __contains__(self, cid: str) -> bool:
        return self._clock.monotonic() < self._known.get(cid, (0, 0.0))[1]

    def add(self, cid: str) -> None:
        """Nobody had it."""
        times = self._known.get(cid, (0, 0.0))[0] + 1
        self._known[cid] = times, self._clock.monotonic() + ABSENT.delay(times)

    def discard(self, cid: str) -> None:
        """It was found."""
        self._known.pop(cid, None)


class Models:
    """Finds the descriptions of models. Most models that exist have none: their file is a text, or nobody serves it."""

    def __init__(self, store: Store, exchange: Exchange, *, kept: int = 256, clock: Clock = SYSTEM_CLOCK) -> None:
        self._store = store
        self._exchange = exchange
        self._known: BoundedDict[str, ModelDescription | None] = BoundedDict(kept)
        self._absent = Absences(kept, clock)
        self._looking = asyncio.Lock()

    async def find(self, cid: str) -> ModelDescription | None:
        """The description of the model with that CID; None if it has none, or if nobody serves it now.

        Raises `InvalidDescription` if the file says that it is a description, and is not a valid one.
        """
        async with self._looking:
            if cid not in self._known:
                if cid in self._absent:
                    return None
                if not await self._read(cid):
                    self._absent.add(cid)
                    return None
            return self._known[cid]

    async def _read(self, cid: str) -> bool:
        """Fetch and read a model's file. False if it is not available now, or too long for a description."""
        try:
            path = await asyncio.to_thread(self._store.checked, cid)
            if path is None and not await self._exchange.is_held(cid, timeout=PATIENCE):
                return False
            path = path or await self._exchange.fetch(
                cid, size_limit=DESCRIPTION_LIMITS.size, timeout=PATIENCE, sync=False
            )
            self._known[cid] = await asyncio.to_thread(description_in, path)
        except (ContentError, OSError):  # or it was evicted just now
            return False
        return True


def description_in(path: Path) -> ModelDescription | None:
    """The description in a model's file; None if it is another file. Raises `InvalidDescription`, `OSError`."""
    with path.open("rb") as file:
        data = file.read(DESCRIPTION_LIMITS.size + 1)
    return read_description(data) if is_description(data) else None

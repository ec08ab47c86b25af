"""Descriptions of models: from the store, or from peers that serve them now."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.clock import SYSTEM_CLOCK
from mesh.errors import ContentError
from mesh.flood import BoundedDict
from mesh.retry import RetryPolicy
from schemas.model import MAX_MODEL_SIZE, ModelDescription, is_description, read_description

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.clock import Clock
    from mesh.content import Exchange, Store

PATIENCE: Final = 3.0
"""Seconds that others have to say that they have a model; if all say at once that they don't, it takes no time."""
ABSENT: Final = RetryPolicy(initial=10.0, ceiling=300.0, jitter=0.0)
"""How long a model that nobody had is not looked for again, by how often it was absent."""
MODELS_KEPT: Final = 256


class Models:
    """Finds the descriptions of models. Most models that exist have none: their file is a text, or nobody serves it."""

    def __init__(self, store: Store, exchange: Exchange, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self._store = store
        self._exchange = exchange
        self._clock = clock
        self._known: BoundedDict[str, ModelDescription | None] = BoundedDict(MODELS_KEPT)
        self._absent: BoundedDict[str, tuple[int, float]] = BoundedDict(MODELS_KEPT)
        """How often a model was absent, and until when it is not looked for."""
        self._looking = asyncio.Lock()

    async def find(self, cid: str) -> ModelDescription | None:
        """The description of the model with that CID; None if it has none, or if nobody serves it now.

        Raises `InvalidDescription` if the file says that it is a description, and is not a valid one.
        """
        async with self._looking:
            if cid not in self._known:
                times, until = self._absent.get(cid, (0, 0.0))
                if self._clock.monotonic() < until:
                    return None
                if not await self._read(cid):
                    self._absent[cid] = times + 1, self._clock.monotonic() + ABSENT.delay(times + 1)
                    return None
            return self._known[cid]

    async def _read(self, cid: str) -> bool:
        """Fetch and read a model's file. False if it is not available now, or too long for a description."""
        try:
            path = await asyncio.to_thread(self._store.checked, cid)
            if path is None and not await self._exchange.is_held(cid, timeout=PATIENCE):
                return False
            path = path or await self._exchange.fetch(cid, size_limit=MAX_MODEL_SIZE, timeout=PATIENCE, sync=False)
            self._known[cid] = await asyncio.to_thread(description_in, path)
        except (ContentError, OSError):  # or it was evicted just now
            return False
        return True


def description_in(path: Path) -> ModelDescription | None:
    """The description in a model's file; None if it is another file. Raises `InvalidDescription`, `OSError`."""
    with path.open("rb") as file:
        data = file.read(MAX_MODEL_SIZE + 1)
    return read_description(data) if is_description(data) else None

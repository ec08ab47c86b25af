"""Fetches objectives and checks that they can be played."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.errors import InputError
from mesh.recording import Limits, preflight
from mesh.settings import LONGEST

if TYPE_CHECKING:
    from mesh.content import Exchange, Store
    from mesh.recording import Objective
    from mesh.settings import ContentSettings
    from mesh.work.job import TopicHandlers

FETCHES: Final = 32
"""Objectives fetched at once: one that nobody has must not delay the others."""
PREFLIGHTS: Final = 1
"""Objectives checked at once: a check uses one core, and up to 256 MiB of memory for a malicious file."""


class ObjectiveUnfit(InputError, code="objective-unfit"):
    """An objective can't be played here. `reason` is the word for programs that the check gave."""

    def __init__(self, cid: str, reason: str, detail: str) -> None:
        super().__init__(f"objective {cid} can't be played ({reason}): {detail}")
        self.cid = cid
        self.reason = reason


class Objectives:
    """The objectives of jobs and of orders. With `handlers`, an objective must fit them."""

    def __init__(
        self, store: Store, exchange: Exchange, settings: ContentSettings, handlers: TopicHandlers | None = None
    ) -> None:
        self._store = store
        self._exchange = exchange
        self._settings = settings
        self._handlers = handlers
        self._fetching = asyncio.Semaphore(FETCHES)
        self._checking = asyncio.Semaphore(PREFLIGHTS)

    async def examine(self, cid: str, *, patience: float = LONGEST) -> Objective:
        """The objective with that CID, from the store or fetched from the mesh, after it was checked.

        Fetching fails after `patience`, or the setting `fetch_timeout`, seconds without a new block. Raises
        `ObjectiveUnfit` and branches of `ContentError`.
        """
        settings, handlers = self._settings, self._handlers
        async with self._fetching:
            path = await asyncio.to_thread(self._store.checked, cid) or await self._exchange.fetch(
                cid, size_limit=settings.objective_size_limit, timeout=min(patience, settings.fetch_timeout)
            )
        limits = Limits(size=settings.objective_size_limit, expanded=settings.objective_expanded_limit)
        topics, obstacle = (None, None) if handlers is None else (handlers.topics, handlers.obstacle)
        async with self._checking:
            outcome = await asyncio.to_thread(preflight, path, limits, topics=topics, obstacle=obstacle)
        if outcome.objective is None or not outcome.ok:
            raise ObjectiveUnfit(cid, outcome.reason, outcome.detail)
        return outcome.objective

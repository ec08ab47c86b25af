"""The objectives of jobs, and of jobs offered: many fetched at once, examined in turn, kept at hand until the end."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from mesh.settings import LONGEST

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from mesh.recording import Objective
    from mesh.work.job import TopicHandler
    from mesh.work.workshop import Workshop

FETCHES: Final = 32
"""Objectives looked for at once: one that nobody has must not hold up the others until its time is over."""
EXAMINATIONS: Final = 1
"""Objectives examined at once: it takes one core, and up to 256 MiB of memory when a file is out to harm us."""


class Objectives:
    """Objectives by the address of their liability, each fit to be played by the performer (None: by anybody)."""

    def __init__(self, shop: Workshop, *, performer: TopicHandler | None) -> None:
        self._shop = shop
        self._performer = performer
        self._fetching = asyncio.Semaphore(FETCHES)
        self._examining = asyncio.Semaphore(EXAMINATIONS)
        self._preparing: dict[str, asyncio.Task[None]] = {}
        self._at_hand: dict[str, Objective] = {}

    def __contains__(self, address: str) -> bool:
        return address in self._at_hand

    def __getitem__(self, address: str) -> Objective:
        return self._at_hand[address]

    def prepare(self, address: str, work: Coroutine[None, None, None], tasks: asyncio.TaskGroup) -> None:
        """Run `work`, which is to end with `keep` or with the job, as one of `tasks`."""
        preparing = self._preparing[address] = tasks.create_task(work, name=f"prepare {address}")
        preparing.add_done_callback(lambda task: self._prepared(address, task))

    async def examine(self, cid: str, *, patience: float = LONGEST) -> Objective:
        """The objective of that CID, found fit to be played here. Raises `UnfitObjective` or a `ContentError`.

        `patience` is as for `Workshop.fetch`.
        """
        async with self._fetching:
            path = await self._shop.fetch(cid, patience=patience)
        async with self._examining:
            return await self._shop.examine(cid, path, performer=self._performer)

    def keep(self, address: str, objective: Objective) -> None:
        """Have it at hand until `forget`."""
        self._at_hand[address] = objective

    def forget(self, address: str) -> None:
        """The job has ended. Unknown ones are ignored."""
        self._at_hand.pop(address, None)

    async def wait(self, address: str) -> None:
        """Return when the objective is at hand, or nobody prepares it any more."""
        preparing = self._preparing.get(address)
        if preparing is not None and address not in self._at_hand:
            await asyncio.wait([preparing])

    def _prepared(self, address: str, task: asyncio.Task[None]) -> None:
        if self._preparing.get(address) is task:
            del self._preparing[address]

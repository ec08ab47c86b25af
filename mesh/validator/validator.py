"""The validator, which users write or run: policies, checks of their own, and `run`."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.settings import Settings

if TYPE_CHECKING:
    from contextlib import AsyncExitStack

from mesh.role import Lifecycle


class Validator(Lifecycle):
    """Judges the results of liabilities that name it: `validator = Validator(settings=…)`, then `validator.run()`."""

    title = "validator"

    def __init__(self, *, settings: Settings | None = None) -> None:
        self.settings = Settings() if settings is None else settings

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM. Prints errors that people can fix in one line, with exit code 1 or 2."""
        from mesh.running import run_until_stopped

        run_until_stopped(self.serve, settings=self.settings, role="validator")

    async def serve(self) -> None:
        """Serve until cancelled."""
        async with self:
            await asyncio.Event().wait()

    async def _open(self, stack: AsyncExitStack) -> None:
        raise NotImplementedError

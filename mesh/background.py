"""Tasks that run beside the body of an `async with`, and calls from other threads."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from contextvars import Context
    from types import TracebackType


def call_in_loop(
    loop: asyncio.AbstractEventLoop, function: Callable[..., object], *arguments: Any, context: Context | None = None
) -> None:
    """Schedule `function` on the event loop from any thread; does nothing if the loop has been closed.

    It runs in `context`, so that log events carry their source; Zenoh's threads have no context of their own.
    """
    try:
        loop.call_soon_threadsafe(function, *arguments, context=context)
    except RuntimeError:
        if not loop.is_closed():
            raise


class Background:
    """`async with Background() as tasks: tasks.start(...)`; leaving it cancels the tasks.

    If a task fails, the body is cancelled and the task's error is raised (in a group if several failed).
    """

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[Any]] = set()

    async def __aenter__(self) -> Self:
        self._group = asyncio.TaskGroup()
        await self._group.__aenter__()
        return self

    def start(self, work: Coroutine[Any, Any, Any], name: str) -> None:
        """Run a coroutine as a task of that name."""
        task = self._group.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        try:
            await self._group.__aexit__(kind, error, trace)
        except BaseExceptionGroup as group:
            if len(group.exceptions) == 1:
                raise group.exceptions[0] from None
            raise

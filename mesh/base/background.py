"""Tasks that run beside the body of an `async with`, functions in threads, and calls from other threads."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Future
from contextvars import copy_context
from typing import TYPE_CHECKING, Any, Self, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from contextvars import Context
    from types import TracebackType

T = TypeVar("T")


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


def in_daemon_thread(function: Callable[[], T], name: str) -> Future[T]:
    """Start a function that may block in a thread of that name, in the caller's context; returns its outcome.

    The thread delays neither other work nor the end of the process; those of `asyncio.to_thread` are few. Nothing can
    stop the function. If it raises `StopIteration`, which a future can't hold, that is a `RuntimeError`.
    """
    context, outcome = copy_context(), Future[T]()
    outcome.set_running_or_notify_cancel()  # so that it can't be cancelled, and the thread can set it

    def run() -> None:
        try:
            outcome.set_result(context.run(function))
        except StopIteration as error:
            outcome.set_exception(RuntimeError(f"{name} raised {error!r}"))
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return outcome


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

    def start(self, work: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        """Run a coroutine as a task of that name; returns the task."""
        task = self._group.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

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

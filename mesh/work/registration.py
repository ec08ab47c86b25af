"""Registering the functions of users: what can't work is an error at once, with the line of the user's code.

A handler may be sync or async. A sync one runs in a thread of its own, so that it may block.
"""

from __future__ import annotations

import asyncio
import contextvars
import inspect
import sys
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

T = TypeVar("T")

_OURS: Final = frozenset({"mesh", "schemas", "bridges"})
"""The packages whose code is not the user's."""


class RegistrationError(ConfigurationError, code="registration-error"):
    """A program gives its agent something that can't work. `file` and `line` say where in the program."""

    def __init__(self, why: str, *, hint: str = "") -> None:
        frame = user_frame()
        self.file, self.line = frame.f_code.co_filename, frame.f_lineno
        super().__init__(f"{_shown(self.file)}:{self.line}: {why}", hint=hint)


class InvalidHandler(RegistrationError, code="invalid-handler"):
    """A handler is no function, or does not take the arguments that it will get."""


def check_handler(handler: Any, wanted: str, *, arguments: int) -> None:
    """Raise `InvalidHandler` unless `handler` can be called with that many arguments, which `wanted` names."""
    name = name_of(handler)
    hint = f"write `async def {name}({wanted})`, or without `async`"
    if not callable(handler):
        raise InvalidHandler(f"{handler!r} is not a function", hint="write the decorator above a function")
    for checked in (handler, getattr(handler, "__call__", None)):  # noqa: B004
        if inspect.isgeneratorfunction(checked) or inspect.isasyncgenfunction(checked):
            raise InvalidHandler(f"the handler {name} is a generator: nothing would run it", hint=hint)
    try:
        inspect.signature(handler).bind(*[None] * arguments)
    except TypeError as error:
        raise InvalidHandler(f"the handler {name} must take ({wanted}): {error}", hint=hint) from None
    except ValueError:
        return  # a function without a signature, written in C


def name_of(handler: Any) -> str:
    """A handler's name for people."""
    return str(getattr(handler, "__name__", None) or type(handler).__name__)


def user_frame() -> FrameType:
    """The innermost frame of the user's code: the first one outside of our packages."""
    frame = sys._getframe(1)
    while (caller := frame.f_back) and frame.f_globals.get("__name__", "").partition(".")[0] in _OURS:
        frame = caller
    return frame


async def call_handler(handler: Callable[..., object], *arguments: Any) -> None:
    """Call a handler, a sync one in a thread. Raises what it raises.

    Cancelling stops an async handler; a sync one continues in its thread, and nothing waits for it.
    """
    if inspect.iscoroutinefunction(inspect.unwrap(handler)):
        outcome = handler(*arguments)
    else:
        outcome = await in_daemon_thread(handler, *arguments)
    if inspect.isawaitable(outcome):
        await outcome


async def in_daemon_thread(function: Callable[..., T], *arguments: Any) -> T:
    """The result of a function that may block. Its daemon thread delays neither other work nor the end of the process.

    The threads of `asyncio.to_thread` are few, and the agent's own work needs them.
    """
    context, outcome = contextvars.copy_context(), Future[T]()
    outcome.set_running_or_notify_cancel()  # so that it can't be cancelled, and the thread can set it

    def run() -> None:
        try:
            outcome.set_result(context.run(function, *arguments))
        except StopIteration as error:  # a future can't hold it
            outcome.set_exception(RuntimeError(f"{name_of(function)} raised {error!r}"))
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=run, name=f"handler {name_of(function)}", daemon=True).start()
    return await asyncio.wrap_future(outcome)


def _shown(file: str) -> str:
    """A file's path as short as it can be."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file

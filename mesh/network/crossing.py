"""From the threads of Zenoh into the event loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable
    from contextvars import Context


def call_in_loop(
    loop: asyncio.AbstractEventLoop, function: Callable[..., object], *arguments: Any, context: Context | None = None
) -> None:
    """Let the loop call `function` soon, from any thread; nothing happens when the loop has ended meanwhile.

    It is called in `context`: what is logged knows whose it is, which Zenoh's threads do not.
    """
    try:
        loop.call_soon_threadsafe(function, *arguments, context=context)
    except RuntimeError:
        if not loop.is_closed():
            raise

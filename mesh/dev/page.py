"""The page of a market in this process. Another package serves it: an entry point of the group `aira.pages`."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from mesh.base.extras import PackageMissing, entry_points, needs_extra

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AbstractAsyncContextManager

    from mesh.agent.agent import Agent
    from mesh.chain import Chain
    from mesh.settings import Settings

ENTRY_POINTS: Final = "aira.pages"
PAGE_PORT: Final = 8585
"""Where people look for a page."""


class ServePage(Protocol):
    """A page that can be served."""

    def __call__(
        self, settings: Settings, *, chain: Chain | None = None, agent: Agent | None = None
    ) -> AbstractAsyncContextManager[str]:
        """Serve the page on this machine; gives its address. Raises `PortUnavailable`.

        It uses `chain` (open), or that of the settings, and orders for `agent` (open), if one is given.
        """


def page_server(port: int | None) -> ServePage:
    """The installed page, to be served at a port; 0 is a free one, and None is `PAGE_PORT`, or a free one if that is
    taken.

    Raises `PackageMissing` if there is no page, or if it lacks a package, and `PortUnavailable` for a port that is
    given and taken.
    """
    entry = next(iter(entry_points(ENTRY_POINTS).values()), None)
    if entry is None:
        raise PackageMissing("bridges", extra="web", user="the page")
    with needs_extra("web", "the page"):
        serve = entry.load()
    if port is None:
        return partial(_at_the_usual_port, serve)
    from mesh.dev.anvil import check_port

    return partial(serve, port=check_port("127.0.0.1", port))


@asynccontextmanager
async def _at_the_usual_port(
    serve: Callable[..., AbstractAsyncContextManager[str]], settings: Settings, **uses: Any
) -> AsyncIterator[str]:
    from mesh.errors import PortUnavailable

    async with AsyncExitStack() as stack:
        try:
            url = await stack.enter_async_context(serve(settings, port=PAGE_PORT, **uses))
        except PortUnavailable:
            url = await stack.enter_async_context(serve(settings, port=0, **uses))
        yield url

"""The page of a market in this process. Another package serves it: an entry point of the group `aira.pages`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from mesh.base.extras import PackageMissing, needs_extra
from mesh.base.plugins import entry_points

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from mesh.agent.agent import Agent
    from mesh.chain import Chain
    from mesh.settings import Settings

ENTRY_POINTS: Final = "aira.pages"
PAGE_PORT: Final = 8585
"""Where people look for a page."""


class ServePage(Protocol):
    """What the entry point names."""

    def __call__(
        self, settings: Settings, *, port: int, chain: Chain | None = None, agent: Agent | None = None
    ) -> AbstractAsyncContextManager[str]:
        """Serve the page on this machine; gives its address. Port 0 is a free one.

        It uses `chain` (open), or that of the settings, and orders for `agent` (open), if one is given.
        """


def page_server() -> ServePage:
    """The installed page. Raises `PackageMissing` if there is none, or if it lacks a package."""
    entry = next(iter(entry_points(ENTRY_POINTS).values()), None)
    if entry is None:
        raise PackageMissing("bridges", extra="web", user="the page")
    with needs_extra("web", "the page"):
        found: ServePage = entry.load()
    return found


def free_page_port(port: int | None) -> int:
    """The port for a page; for None `PAGE_PORT`, or a free one if that is taken. Raises `PortUnavailable`."""
    from mesh.dev.anvil import check_port
    from mesh.errors import PortUnavailable

    try:
        return check_port("127.0.0.1", PAGE_PORT if port is None else port)
    except PortUnavailable:
        if port is not None:
            raise
        return check_port("127.0.0.1", 0)

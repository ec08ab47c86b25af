"""A Foxglove server on a free port."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from bridges.foxglove.server import FoxgloveFront, FoxgloveOptions, FoxgloveServer
from mesh.base.flood import Drops

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AbstractAsyncContextManager


@pytest.fixture
def front() -> Callable[..., FoxgloveFront]:
    """A front on a free port, not yet open."""

    def made(**options: Any) -> FoxgloveFront:
        return FoxgloveFront(FoxgloveOptions(**({"port": 0} | options)), Drops())

    return made


@pytest.fixture
def serve(front: Callable[..., FoxgloveFront]) -> Callable[..., AbstractAsyncContextManager[FoxgloveServer]]:
    """Serves a view; `server.front` has its address."""

    @asynccontextmanager
    async def serving(known: Any = (), **options: Any) -> AsyncIterator[FoxgloveServer]:
        async with (
            front(**options) as open_front,
            FoxgloveServer(open_front, "test", known=known) as server,
        ):
            yield server

    return serving

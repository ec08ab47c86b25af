from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ClosedError
from mesh.role import Role

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from contextlib import AsyncExitStack


class Clerk(Role):
    """Opens two drawers, of which the second may be stuck, and writes."""

    title = "clerk"

    def __init__(self, *, stuck: bool = False) -> None:
        self.done: list[str] = []
        self._stuck = stuck

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self._drawer("upper"))
        if self._stuck:
            raise OSError("stuck")
        await stack.enter_async_context(self._drawer("lower"))

    async def _work(self) -> None:
        self.done.append("writes")
        await asyncio.Event().wait()

    @asynccontextmanager
    async def _drawer(self, name: str) -> AsyncIterator[None]:
        self.done.append(f"opens {name}")
        try:
            yield
        finally:
            self.done.append(f"closes {name}")


async def test_a_role_works_while_it_is_open_and_closes_the_last_first() -> None:
    clerk = Clerk()
    async with clerk:
        assert clerk.is_open
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await clerk.run()
    assert clerk.done == ["opens upper", "opens lower", "writes", "closes lower", "closes upper"]
    assert not clerk.is_open


async def test_a_role_that_is_not_open_does_not_run_and_one_that_is_does_not_open_again() -> None:
    clerk = Clerk()
    with pytest.raises(ClosedError, match="this clerk is not open"):
        await clerk.run()
    async with clerk:
        with pytest.raises(ClosedError, match="this clerk is open already"):
            await clerk.__aenter__()
        assert clerk.done == ["opens upper", "opens lower"]
    async with clerk:
        assert clerk.is_open


async def test_what_was_opened_is_closed_where_the_rest_can_not_be() -> None:
    clerk = Clerk(stuck=True)
    with pytest.raises(OSError, match="stuck"):
        await clerk.__aenter__()
    assert clerk.done == ["opens upper", "closes upper"]
    assert not clerk.is_open

"""How a role opens, runs and closes."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from mesh.base.lifecycle import Role
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from contextlib import AsyncExitStack


class ExampleRole(Role):
    """Opens two parts, `first` and `second`, and works. It may fail between them."""

    title = "example"

    def __init__(self, *, fails: bool = False) -> None:
        self.done: list[str] = []
        self._fails = fails

    async def _open(self, stack: AsyncExitStack) -> None:
        await stack.enter_async_context(self._part("first"))
        if self._fails:
            raise OSError("broken")
        await stack.enter_async_context(self._part("second"))

    async def _work(self) -> None:
        self.done.append("works")
        await asyncio.Event().wait()

    @asynccontextmanager
    async def _part(self, name: str) -> AsyncIterator[None]:
        self.done.append(f"opens {name}")
        try:
            yield
        finally:
            self.done.append(f"closes {name}")


async def test_a_role_works_while_it_is_open_and_closes_in_reverse_order() -> None:
    role = ExampleRole()
    async with role:
        assert role.is_open
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await role.run()
    assert role.done == ["opens first", "opens second", "works", "closes second", "closes first"]
    assert not role.is_open


async def test_a_closed_role_can_not_run_and_an_open_one_can_not_be_opened_twice() -> None:
    role = ExampleRole()
    with pytest.raises(ClosedError):
        await role.run()
    async with role:
        with pytest.raises(ClosedError):
            await role.__aenter__()
        assert role.done == ["opens first", "opens second"]
    async with role:
        assert role.is_open


async def test_opened_parts_are_closed_when_opening_fails() -> None:
    role = ExampleRole(fails=True)
    with pytest.raises(OSError, match="broken"):
        await role.__aenter__()
    assert role.done == ["opens first", "closes first"]
    assert not role.is_open

"""The base classes of roles, such as provider, bridge and agent, and of their parts that are opened with them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AsyncExitStack
from typing import ClassVar, Self

from mesh.errors import ClosedError


class Lifecycle(ABC):
    """`async with` opens it. Leaving closes everything in reverse order.

    A subclass sets `title` and opens what it needs in `_open`. If `_open` fails, what it opened until then is closed.
    """

    title: ClassVar[str]
    """Its name in error messages."""
    _stack: AsyncExitStack | None = None

    async def __aenter__(self) -> Self:
        if self._stack is not None:
            raise ClosedError(f"this {self.title} is open already")
        async with AsyncExitStack() as stack:
            await self._open(stack)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        stack, self._stack = self._stack, None
        if stack is not None:
            await stack.aclose()

    @property
    def is_open(self) -> bool:
        """Whether it is inside `async with`."""
        return self._stack is not None

    def check_open(self) -> AsyncExitStack:
        """What is closed when it is left. Raises `ClosedError` outside `async with`."""
        if self._stack is None:
            raise ClosedError(f"this {self.title} is not open", hint="use it inside `async with`")
        return self._stack

    @abstractmethod
    async def _open(self, stack: AsyncExitStack) -> None:
        """Open what it needs, on `stack`."""


class Role(Lifecycle):
    """`async with role`, then `await role.run()`. A subclass works in `_work`."""

    async def run(self) -> None:
        """Work until cancelled. Raises `ClosedError` outside `async with`."""
        self.check_open()
        await self._work()

    @abstractmethod
    async def _work(self) -> None:
        """Do the role's work until cancelled."""

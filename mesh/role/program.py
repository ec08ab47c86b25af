"""A role as users run it in a program of theirs, such as an agent or a validator. From outside to inside:

run               signals, errors in one line, exit codes
  serve           again and again, if a development chain is started afresh
    async with    its telemetry; it waits for its files, decrypts the key, opens the role, and starts its tasks
      the role    what it has open, its tasks, what events on the chain mean to it (`FollowsChain`)
"""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple, TypeVar

from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import LogSource, source_context
from mesh.base.retry import RetryPolicy
from mesh.role.composition import load_account
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path
    from typing import Any

    from mesh.chain import Account, Chain
    from mesh.settings import Settings
    from mesh.telemetry.serving import HealthCheck, Measure

T = TypeVar("T")

RESEND: Final = RetryPolicy(initial=0.5, ceiling=300.0)
"""How long to wait for the effect of a message before it is sent again."""


class OpenRole(NamedTuple):
    """A role that is open: what it shows of itself, and the coroutines that are its tasks, with their names."""

    measure: Measure
    health: HealthCheck
    tasks: Callable[[], Iterable[tuple[str, Coroutine[Any, Any, object]]]]


class Program(Lifecycle):
    """The life of a role: `run`, or `async with`. It opens nothing before.

    `account` and `chain` (open), if given, are used instead of those that the settings name.
    """

    needs_account: ClassVar[bool] = True

    def __init__(self, settings: Settings, *, account: Account | None, chain: Chain | None) -> None:
        self.settings = settings
        self._account = account
        self._given_chain = chain
        self._place: Path | None = None
        """The folder of what belongs to the chain on which it was open last."""
        self.telemetry = Telemetry(settings.metrics_listen)
        """Serves its metrics and its health if the settings say where."""
        self.drops = Drops()
        """Counts what was dropped, of what strangers sent."""

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM. Prints errors that people can fix in one line, with exit code 1 or 2."""
        run_until_stopped(self.serve, settings=self.settings, role=self.title)

    async def serve(self) -> None:
        """Serve until cancelled, also when a development chain is started afresh."""
        if self._given_chain is not None:
            await self._serve(self.settings)
        else:
            await serve_on_each_chain(self.settings, self._serve, place=lambda: self._place)

    async def _serve(self, settings: Settings) -> None:
        self.settings = settings
        async with self:
            await asyncio.Event().wait()

    async def _open(self, stack: AsyncExitStack) -> None:
        stack.callback(self._closed)
        await stack.enter_async_context(self.telemetry)
        await wait_for_files(self.settings)
        account = self._account
        if account is None and (self.needs_account or self.settings.keyfile):
            account = await asyncio.to_thread(load_account, self.settings)
        address = "" if account is None else account.address
        source = LogSource(self.title, address, self.settings.lighthouse_contract.lower())
        set_process_source(source)
        with source_context(source):
            role = await self._open_role(stack, account)
            stack.enter_context(self.telemetry.showing(measure=role.measure, health=role.health))
            # The tasks are entered last, so they end first: what handlers and jobs use is open until then.
            tasks = await stack.enter_async_context(Background())
            for name, work in role.tasks():
                tasks.start(work, name)
            tasks.start(self.drops.run(), "drops")

    @abstractmethod
    async def _open_role(self, stack: AsyncExitStack, account: Account | None) -> OpenRole:
        """Open the role on `stack`; its tasks are started afterwards."""

    async def _open_when_ready(self, stack: AsyncExitStack, make: Callable[[], AbstractAsyncContextManager[T]]) -> T:
        """What `make` opens, once its dependencies are there, if the settings say to wait for them."""
        return await open_when_ready(stack, self.settings, make, role=self.title, on_wait=self.telemetry.starting)

    @abstractmethod
    def _closed(self) -> None:
        """Forget what was open."""

"""A role as users run it in a program of theirs, such as an agent or a validator. From outside to inside:

run               signals, errors in one line, exit codes
  serve           again and again, if a development chain is started afresh
    async with    its telemetry; it waits for its files, decrypts the key, opens the role, and starts its tasks
      the role    what it has open, its tasks, what events on the chain mean to it (`FollowsChain`)

`RoleStatus` and `WatcherStatus` are its metrics, health and status, which ask nothing of the network.
"""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, TypeVar

import mesh
from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import LogSource, source_context
from mesh.base.retry import RetryPolicy
from mesh.network.channel import message_families
from mesh.role.composition import load_account
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.telemetry.logs import set_process_source
from mesh.telemetry.metrics import drop_family, gauge, labelled, public_parts
from mesh.telemetry.serving import Telemetry
from schemas.status import ALIVE, Status, StoreUse

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
    from contextlib import AbstractAsyncContextManager, AsyncExitStack
    from pathlib import Path

    from mesh.chain import Account, Chain
    from mesh.network import Channel, Network, Subscription
    from mesh.role.composition import RoleParts
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily
    from mesh.telemetry.serving import HealthCheck, Measure
    from schemas.rpc import Nothing

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


P = TypeVar("P", bound="RoleParts[Any]")


class WatcherStatus:
    """The metrics and the health of a role without an account, which only receives the market's messages."""

    def __init__(self, network: Network, channel: Channel, drops: Drops) -> None:
        self._drops = drops
        self._network = network
        self._channel = channel

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics of its subscriptions and its session."""
        received = labelled(
            (*message_families(subscriptions), drop_family(self._drops)), lighthouse=self._channel.lighthouse
        )
        return (*received, *self._network.families())

    def health(self) -> Mapping[str, str]:
        """The state of its one part, the channel."""
        return {"channel": self._network.state}


class RoleStatus(ABC, Generic[P]):
    """The metrics, the health and the service `status` of a role with `parts`."""

    role: ClassVar[str]

    def __init__(self, parts: P) -> None:
        self.parts = parts
        self._started = time.monotonic()

    async def status(self, _request: Nothing) -> Status:
        parts, usage = self.parts, await asyncio.to_thread(self.parts.store.usage)
        return Status(
            role=self.role,
            address=parts.signer.address,
            version=mesh.__version__,
            zenoh_id=parts.network.id,
            lighthouse=parts.channel.lighthouse,
            parts=public_parts(self.health()),
            head=parts.chain_head.head,
            chain_id=parts.chain.chain_id,
            xrt=parts.chain.xrt,
            uptime=round(time.monotonic() - self._started, 3),
            dropped=parts.drops.totals(),
            heaviest=parts.drops.senders(),
            **await self._own_status(StoreUse(files=usage.files, bytes=usage.bytes, quota=usage.quota)),
        )

    def health(self) -> dict[str, str]:
        return {
            "channel": self.parts.network.state,
            "listener": "waits for the node" if self.parts.outages.is_down else ALIVE,
        }

    async def measure(self, subscriptions: Sequence[Subscription[Any]]) -> tuple[MetricFamily, ...]:
        """The metrics now; `subscriptions` are those of its market."""
        parts, usage = self.parts, await asyncio.to_thread(self.parts.store.usage)
        families = (
            *message_families(subscriptions),
            drop_family(parts.drops),
            *await self._own_families(),
            gauge("aira_content_files", "Files in the content store", usage.files),
            gauge("aira_content_bytes", "Bytes of the content store", usage.bytes),
            *(() if usage.quota is None else (gauge("aira_content_quota_bytes", "The store's quota", usage.quota),)),
            *parts.chain_head.families(),
        )
        own = labelled(families, lighthouse=parts.channel.lighthouse)
        return (*own, *parts.network.families(), *await parts.chain.measure())

    @abstractmethod
    async def _own_status(self, store: StoreUse) -> dict[str, Any]:
        """The fields of its status that others don't have; `store` is what it has in its store."""

    @abstractmethod
    async def _own_families(self) -> tuple[MetricFamily, ...]:
        """The metrics that others don't have."""

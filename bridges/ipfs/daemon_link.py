"""The link to an IPFS daemon: holds the subscription, watches the daemon's health, reconnects after an outage."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from bridges.ipfs.errors import IpfsError
from mesh.log_context import log_event
from mesh.outage_log import OutageLog
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.pubsub import PubsubMessage

    Received = Callable[[PubsubMessage | None], Awaitable[None]]

log = logging.getLogger(__name__)

RECONNECT: Final = RetryPolicy(initial=0.25, ceiling=10.0)
"""The first delay is short, since a restarted daemon is often back at once."""
POLL_INTERVAL: Final = 1.0
"""Seconds between two questions about the topic's listeners."""
SETTLE: Final = 1.5
"""Seconds that a swarm needs after the first listener appears: nodes forward a topic's messages from their next
heartbeat on, which takes up to a second."""
SWARM_INTERVAL: Final = 30.0
"""Seconds between two checks of the daemon's connections to `swarm_peers`."""


class DaemonLink:
    """Receives a topic through `daemon` (open) whenever that is reachable: `await link.run(received, changed)`.

    `swarm_peers` are multiaddrs (`…/p2p/ID`) to which the daemon is kept connected.
    """

    def __init__(
        self, daemon: Daemon, topic: str, *, swarm_peers: tuple[str, ...] = (), retry: RetryPolicy = RECONNECT
    ) -> None:
        self.daemon: Final = daemon
        self.topic: Final = topic
        self._swarm_peers = swarm_peers
        self._retry = retry
        self._unconnected: set[str] = set()
        self._outage = OutageLog(log, "ipfs-daemon")
        self._up = asyncio.Event()
        self.identity = ""
        """The daemon's peer id."""
        self.listeners: tuple[str, ...] = ()
        """The other nodes on the topic, as the daemon last reported them."""
        self.losses = 0
        """How often the daemon was lost."""
        self.error = ""
        """The last error; empty while all is well."""
        self._listeners_at = 0.0
        self._swarm_checked_at = 0.0
        self._heard_since = 0.0
        self._changed: Callable[[], None] = lambda: None

    @property
    def up(self) -> bool:
        """Whether the daemon is subscribed to the topic."""
        return self._up.is_set()

    async def wait_up(self) -> None:
        """Return when the daemon is subscribed."""
        await self._up.wait()

    async def run(self, received: Received, changed: Callable[[], None]) -> None:
        """Pass each message to `received` until cancelled; call `changed` when the link or the listeners change.

        `received` gets None for a line that can't be read.
        """
        self._changed = changed
        backoff = Backoff(self._retry)
        while True:
            try:
                await self._connected(received)
            except* IpfsError as group:
                self._failed(_first(group))
            finally:
                was_up = self.up
                self._up.clear()
                self.listeners = ()
                if was_up:
                    self.losses += 1
                    self._changed()
            if was_up:
                backoff.reset()
            await backoff.wait()

    async def refresh_listeners(self, *, max_age: float = 0.0) -> bool:
        """Whether there are listeners. Asks the daemon, unless it named some less than `max_age` seconds ago.

        That nobody listens is never believed later: a message published in the meantime would be heard and sent again.
        Raises `IpfsError`.
        """
        now = asyncio.get_running_loop().time()
        if not self.listeners or now - self._listeners_at >= max_age:
            before, self.listeners = self.listeners, tuple(await self.daemon.listeners(self.topic))
            self._listeners_at = now
            if bool(before) != bool(self.listeners):
                self._heard_since = now
                if self.up:
                    count = len(self.listeners)
                    changed = log_event("ipfs-listeners-changed", lighthouse=self.topic, listeners=count)
                    log.info("%s: %d listeners", self.topic, count, extra=changed)
                    self._changed()
        return bool(self.listeners)

    async def settled(self) -> None:
        """Return when messages reach all listeners, not only the daemon's neighbours; at once if there are none."""
        since = asyncio.get_running_loop().time() - self._heard_since
        if self.listeners and since < SETTLE:
            await asyncio.sleep(SETTLE - since)

    async def _connected(self, received: Received) -> None:
        version = await self.daemon.detect_version()
        self.identity = (await self.daemon.identity()).id
        async with asyncio.TaskGroup() as tasks, self.daemon.subscribe(self.topic) as messages:
            self._swarm_checked_at = 0.0
            await self.refresh_listeners()
            self.error = ""
            self._up.set()
            self._outage.recovered(f"{self.topic}: the IPFS daemon is back")
            subscribed = log_event("ipfs-subscribed", lighthouse=self.topic, api=self.daemon.api, version=version)
            log.info(
                "%s: subscribed at %s (%s, %s)",
                self.topic,
                self.daemon.api,
                version,
                self.daemon.dialect,
                extra=subscribed,
            )
            self._changed()
            tasks.create_task(self._poll(), name=f"listeners of {self.topic}")
            async for message in messages:
                await received(message)

    async def _poll(self) -> None:
        """Ask for listeners periodically. This detects a daemon that stopped answering but kept its connections."""
        while True:
            await self._check_swarm()
            await self.refresh_listeners()
            await asyncio.sleep(POLL_INTERVAL)

    async def _check_swarm(self) -> None:
        now = asyncio.get_running_loop().time()
        if not self._swarm_peers or (self._swarm_checked_at and now - self._swarm_checked_at < SWARM_INTERVAL):
            return
        self._swarm_checked_at = now
        connected = set(await self.daemon.swarm_peers())
        for address in self._swarm_peers:
            if address.rpartition("/")[2] not in connected:
                await self._connect_peer(address)

    async def _connect_peer(self, address: str) -> None:
        try:
            await self.daemon.connect(address)
        except IpfsError as error:
            if address not in self._unconnected:
                failed = log_event("swarm-peer-unreachable", lighthouse=self.topic, peer=address, error=error)
                log.warning("%s: not connected to %s: %s", self.topic, address, error, extra=failed)
            self._unconnected.add(address)
        else:
            connected = log_event("swarm-peer-connected", lighthouse=self.topic, peer=address)
            log.info("%s: connected to %s", self.topic, address, extra=connected)
            self._unconnected.discard(address)

    def _failed(self, error: IpfsError) -> None:
        self._outage.failed(error, f"{self.topic}: not subscribed on IPFS")
        self.error = str(error)


def _first(group: BaseExceptionGroup[IpfsError]) -> IpfsError:
    """One of the errors in a group: they have one cause."""
    error = group.exceptions[0]
    return _first(error) if isinstance(error, BaseExceptionGroup) else error

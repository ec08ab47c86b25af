"""Publishing queued messages: to IPFS through the daemon, to the mesh through the router."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from bridges.ipfs.errors import DaemonRefused, DaemonUnreachable, NoPeers, PublishedOutOfOrder
from bridges.ipfs.journal import Side
from bridges.ipfs.status import RateMeter
from mesh.log_context import log_event
from mesh.network import NetworkChange, sending
from mesh.retry import Backoff, RetryPolicy

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ipfs.daemon_link import DaemonLink
    from bridges.ipfs.publish_queue import QueuedMessage
    from bridges.ipfs.relay import MessageRelay
    from bridges.ipfs.validation import RelayMessage
    from mesh.network import Network

    Published = Callable[[Side, RelayMessage], None]

log = logging.getLogger(__name__)

BRIDGE_MARK: Final = b"ipfs"
"""The attachment of messages that a bridge puts on the mesh; other bridges do not send those back."""
LISTENERS_MAX_AGE: Final = 0.1
"""Seconds for which the daemon's answer that somebody listens is believed."""
PUBLISH_RETRY: Final = RetryPolicy(initial=0.5, factor=1.0, ceiling=0.5)
"""A steady, short delay: a failed message blocks those behind it, and an unreachable daemon is awaited elsewhere."""
REFUSALS: Final = 5
"""How often the daemon may refuse a message before it is dropped."""
UNCERTAIN: Final = 3.0
"""Seconds before the loss of the router in which a put may already have vanished; such puts are repeated."""
RECENT_PUTS: Final = 4096
"""Puts that are kept for repetition."""


class IpfsPublisher:
    """Publishes the messages queued for IPFS, one after another, while the daemon is subscribed."""

    def __init__(self, link: DaemonLink, relay: MessageRelay, published: Published, retry: RetryPolicy) -> None:
        self._link = link
        self._relay = relay
        self._published = published
        self._backoff = Backoff(retry)
        self._work = asyncio.Event()
        self.rate: Final = RateMeter(time.monotonic)

    def wake(self) -> None:
        """The queue may have a message."""
        self._work.set()

    async def run(self) -> None:
        """Publish until cancelled. Raises nothing: failed messages are retried, or dropped and counted."""
        refusals = 0
        while True:
            await self._link.wait_up()
            queued = self._relay.queues[Side.IPFS].next()
            if queued is None:
                self._work.clear()
                await self._work.wait()
                continue
            try:
                await self._publish(queued)
                refusals = 0
                self._backoff.reset()
            except (NoPeers, PublishedOutOfOrder):  # expected now and then, so not reported as an error
                await self._backoff.wait()
            except DaemonUnreachable as error:
                self._link.error = str(error)
                await self._backoff.wait()
            except (DaemonRefused, ValueError) as error:
                refusals += 1
                if refusals < REFUSALS:
                    self._link.error = str(error)
                    await self._backoff.wait()
                    continue
                refusals = 0
                self._drop(queued, error)

    async def _publish(self, queued: QueuedMessage) -> None:
        heard = await self._link.refresh_listeners(max_age=LISTENERS_MAX_AGE)
        await self._link.settled()
        if queued.message.fingerprint not in self._relay.queues[Side.IPFS]:
            return  # another node has published it meanwhile
        await self._link.daemon.publish(self._link.topic, queued.message.legacy)
        self._link.error = ""
        self.rate.count()
        self._relay.sent(queued, Side.IPFS, heard=heard)
        self._published(Side.IPFS, queued.message)

    def _drop(self, queued: QueuedMessage, error: Exception) -> None:
        self._relay.refused(queued, Side.IPFS)
        dropped = log_event("message-dropped", lighthouse=self._link.topic, key=queued.message.key, error=error)
        log.warning("%s: IPFS refuses %s: %s", self._link.topic, queued.message.key, error, extra=dropped)


class MeshPublisher:
    """Puts the messages queued for the mesh, one after another, while a router is connected."""

    def __init__(self, network: Network, relay: MessageRelay, published: Published) -> None:
        self._network = network
        self._relay = relay
        self._published = published
        self._work = asyncio.Event()
        self._online = asyncio.Event()
        self._recent: deque[tuple[float, RelayMessage]] = deque(maxlen=RECENT_PUTS)
        self.rate: Final = RateMeter(time.monotonic)

    def wake(self) -> None:
        """The queue may have a message."""
        self._work.set()

    async def run(self) -> None:
        """Publish until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow_network(), name="bridge: the router's connection")
            while True:
                await self._online.wait()
                queued = self._relay.queues[Side.MESH].next()
                if queued is None:
                    self._work.clear()
                    await self._work.wait()
                    continue
                self._put(queued.message)
                self._recent.append((time.monotonic(), queued.message))
                self.rate.count()
                self._relay.sent(queued, Side.MESH, heard=True)
                self._published(Side.MESH, queued.message)
                await asyncio.sleep(0)

    def _put(self, message: RelayMessage) -> None:
        sending.put(self._network.session, message.key, message.payload, attachment=BRIDGE_MARK)

    async def _follow_network(self) -> None:
        """Pause while there is no router, then repeat puts that may have vanished; receivers drop duplicates."""
        if self._network.connected:
            self._online.set()
        lost = 0.0
        async for change in self._network.changes():
            if change is NetworkChange.LOST:
                self._online.clear()
                lost = time.monotonic()
            else:
                for put, message in list(self._recent):
                    if put > lost - UNCERTAIN:
                        self._put(message)
                self._online.set()

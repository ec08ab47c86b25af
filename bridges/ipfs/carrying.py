"""Carrying what waits: to IPFS through the daemon, to the mesh through the router."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from typing import TYPE_CHECKING, Final

import zenoh

from bridges.ipfs.errors import DaemonRefused, DaemonUnreachable, NoPeers, Overtaken
from bridges.ipfs.memory import Side
from bridges.ipfs.status import Rate
from mesh.network import NetworkChange

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ipfs.gate import Passenger
    from bridges.ipfs.link import Link
    from bridges.ipfs.outbox import Waiting
    from bridges.ipfs.traffic import Traffic
    from mesh.network import Network

    Told = Callable[[Side, Passenger], None]

log = logging.getLogger(__name__)

MARK: Final = b"ipfs"
"""The attachment of what a bridge has brought: other bridges do not bring it back."""
FRESH: Final = 0.5
"""Seconds for which it is believed that somebody listens."""
PAUSE: Final = 0.5
"""Seconds before something is published again that failed."""
ATTEMPTS: Final = 5
"""How often a message is published that the daemon refuses."""
UNCERTAIN: Final = 3.0
"""Seconds before the loss of the router in which a put may have vanished already; it is put again."""
RECENT: Final = 4096
"""Puts that are kept for that."""


class ToIpfs:
    """Publishes one message after the other, for as long as the daemon is there: `run` until cancelled."""

    def __init__(self, link: Link, traffic: Traffic, told: Told) -> None:
        self._link = link
        self._traffic = traffic
        self._told = told
        self._work = asyncio.Event()
        self.rate: Final = Rate(time.monotonic)

    def wake(self) -> None:
        """There may be something to carry."""
        self._work.set()

    async def run(self) -> None:
        """Carry until cancelled. Raises nothing: what fails is tried again, or dropped and counted."""
        attempts = 0
        while True:
            await self._link.wait_up()
            waiting = self._traffic.to[Side.IPFS].next()
            if waiting is None:
                self._work.clear()
                await self._work.wait()
                continue
            try:
                await self._publish(waiting)
                attempts = 0
            except (NoPeers, Overtaken, DaemonUnreachable) as error:
                await self._pause(error)
            except (DaemonRefused, ValueError) as error:
                attempts += 1
                if attempts < ATTEMPTS:
                    await self._pause(error)
                    continue
                attempts = 0
                self._traffic.refused(waiting, Side.IPFS)
                log.warning("%s: IPFS refuses %s: %s", self._link.topic, waiting.passenger.key, error)

    async def _publish(self, waiting: Waiting) -> None:
        heard = await self._link.look(younger_than=FRESH)
        await self._link.settled()
        if waiting.passenger.fingerprint not in self._traffic.to[Side.IPFS]:
            return  # somebody else has carried it meanwhile
        await self._link.daemon.publish(self._link.topic, waiting.passenger.legacy)
        self._link.error = ""
        self.rate.count()
        self._traffic.carried(waiting, Side.IPFS, heard=heard)
        self._told(Side.IPFS, waiting.passenger)

    async def _pause(self, error: Exception) -> None:
        if not isinstance(error, NoPeers | Overtaken):  # which are no fault of anybody's
            self._link.error = str(error)
        await asyncio.sleep(PAUSE)


class ToMesh:
    """Puts one message after the other, for as long as there is a router: `run` until cancelled."""

    def __init__(self, network: Network, traffic: Traffic, told: Told) -> None:
        self._network = network
        self._traffic = traffic
        self._told = told
        self._work = asyncio.Event()
        self._online = asyncio.Event()
        self._recent: deque[tuple[float, Passenger]] = deque(maxlen=RECENT)
        self.rate: Final = Rate(time.monotonic)

    def wake(self) -> None:
        """There may be something to carry."""
        self._work.set()

    async def run(self) -> None:
        """Carry until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow_network(), name="bridge: the router's comings and goings")
            while True:
                await self._online.wait()
                waiting = self._traffic.to[Side.MESH].next()
                if waiting is None:
                    self._work.clear()
                    await self._work.wait()
                    continue
                self._put(waiting.passenger)
                self._recent.append((time.monotonic(), waiting.passenger))
                self.rate.count()
                self._traffic.carried(waiting, Side.MESH, heard=True)
                self._told(Side.MESH, waiting.passenger)
                await asyncio.sleep(0)

    def _put(self, passenger: Passenger) -> None:
        self._network.session.put(
            passenger.key,
            passenger.payload,
            encoding="application/json",
            congestion_control=zenoh.CongestionControl.DROP,
            attachment=MARK,
        )

    async def _follow_network(self) -> None:
        """LockedEntry back while there is no router, and put again what vanished: readers drop what they know."""
        if self._network.connected:
            self._online.set()
        lost = 0.0
        async for change in self._network.changes():
            if change is NetworkChange.LOST:
                self._online.clear()
                lost = time.monotonic()
            else:
                for put, passenger in list(self._recent):
                    if put > lost - UNCERTAIN:
                        self._put(passenger)
                self._online.set()

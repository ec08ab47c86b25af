"""The line to an IPFS daemon: its subscription held, its health watched, come back to when it was away."""

from __future__ import annotations

import asyncio
import logging
import random
from typing import TYPE_CHECKING, Final

from bridges.ipfs.errors import IpfsError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from bridges.ipfs.daemon import Daemon
    from bridges.ipfs.dialects import Event

log = logging.getLogger(__name__)

FIRST_PAUSE: Final = 0.25
"""Seconds before the first attempt to reach a lost daemon again; each pause is twice the last one …"""
LONGEST_PAUSE: Final = 10.0
"""… up to this."""
LOOK: Final = 1.0
"""Seconds between two looks at who listens."""
SETTLE: Final = 1.5
"""Seconds that a swarm needs once the first listener is there: nodes that hear of a topic pass its messages on from
their next heartbeat on, which is a second."""
NEIGHBOURS: Final = 30.0
"""Seconds between two looks at whether the daemon is connected to whom it should."""


class Link:
    """Hears a topic through `daemon` (open) whenever that is there: `await link.run(heard, changed)`.

    `neighbours` are swarm multiaddrs (`…/p2p/ID`) to which the daemon is kept connected.
    """

    def __init__(self, daemon: Daemon, topic: str, *, neighbours: tuple[str, ...] = ()) -> None:
        self.daemon: Final = daemon
        self.topic: Final = topic
        self._neighbours = neighbours
        self._away: set[str] = set()
        self._up = asyncio.Event()
        self.identity = ""
        """The daemon's own name in the swarm."""
        self.listeners: tuple[str, ...] = ()
        """The other nodes on the topic, as the daemon knew them a moment ago."""
        self.losses = 0
        """How often the daemon was lost."""
        self.error = ""
        """What went wrong last; empty once the line stands again."""
        self._looked = 0.0
        self._greeted = 0.0
        self._heard_since = 0.0
        self._changed: Callable[[], None] = lambda: None

    @property
    def up(self) -> bool:
        """Whether the subscription stands."""
        return self._up.is_set()

    async def wait_up(self) -> None:
        """Return when the subscription stands."""
        await self._up.wait()

    async def run(self, heard: Callable[[Event | None], Awaitable[None]], changed: Callable[[], None]) -> None:
        """Hand each event to `heard` until cancelled; `changed` is called when the line or the listeners change."""
        self._changed = changed
        pause = FIRST_PAUSE
        while True:
            try:
                await self._connected(heard)
            except* IpfsError as group:
                self._failed(_first(group))
            finally:
                was_up = self.up
                self._up.clear()
                self.listeners = ()
                if was_up:
                    self.losses += 1
                    self._changed()
            pause = FIRST_PAUSE if was_up else min(2 * pause, LONGEST_PAUSE)
            await asyncio.sleep(pause * random.uniform(0.75, 1.25))

    async def look(self, *, younger_than: float = 0.0) -> bool:
        """Whether anybody listens, as the daemon knows it now, or knew it `younger_than` seconds ago.

        Raises `IpfsError`.
        """
        now = asyncio.get_running_loop().time()
        if not self._looked or now - self._looked >= younger_than:
            before, self.listeners = self.listeners, tuple(await self.daemon.listeners(self.topic))
            self._looked = now
            if bool(before) != bool(self.listeners):
                self._heard_since = now
                if self.up:
                    log.info("%s: %d nodes listen", self.topic, len(self.listeners))
                    self._changed()
        return bool(self.listeners)

    async def settled(self) -> None:
        """Return when messages reach more than the daemon's neighbours; at once if nobody listens at all."""
        since = asyncio.get_running_loop().time() - self._heard_since
        if self.listeners and since < SETTLE:
            await asyncio.sleep(SETTLE - since)

    async def _connected(self, heard: Callable[[Event | None], Awaitable[None]]) -> None:
        version = await self.daemon.greet()
        self.identity = (await self.daemon.identity()).id
        async with asyncio.TaskGroup() as tasks, self.daemon.subscribe(self.topic) as events:
            self._looked = self._greeted = 0.0
            await self.look()
            self.error = ""
            self._up.set()
            log.info("%s: subscribed at %s (%s, %s)", self.topic, self.daemon.api, version, self.daemon.dialect)
            self._changed()
            tasks.create_task(self._watch(), name=f"listeners of {self.topic}")
            async for event in events:
                await heard(event)

    async def _watch(self) -> None:
        """Ask who listens, again and again: a daemon that does not answer has lost us, even if nothing broke off."""
        while True:
            await self._greet_neighbours()
            await self.look()
            await asyncio.sleep(LOOK)

    async def _greet_neighbours(self) -> None:
        now = asyncio.get_running_loop().time()
        if not self._neighbours or (self._greeted and now - self._greeted < NEIGHBOURS):
            return
        self._greeted = now
        known = set(await self.daemon.neighbours())
        for address in self._neighbours:
            if address.rpartition("/")[2] not in known:
                await self._greet(address)

    async def _greet(self, address: str) -> None:
        try:
            await self.daemon.connect(address)
        except IpfsError as error:
            if address not in self._away:
                log.warning("%s: not connected to %s: %s", self.topic, address, error)
            self._away.add(address)
        else:
            log.info("%s: connected to %s", self.topic, address)
            self._away.discard(address)

    def _failed(self, error: IpfsError) -> None:
        if str(error) != self.error:
            log.warning("%s: %s (%s)", self.topic, error, error.hint)
        self.error = str(error)


def _first(group: BaseExceptionGroup[IpfsError]) -> IpfsError:
    """One of the errors in a group: they have one cause."""
    error = group.exceptions[0]
    return _first(error) if isinstance(error, BaseExceptionGroup) else error

"""What strangers may use of a server's connections: the same limits for every server of ours.

A `Door` knows who is connected. When there are too many connections, the one that has waited longest
without a whole request makes room: those who ask something are heard in a flood of connections that ask nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import threading
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

from mesh.base.clock import SYSTEM_CLOCK

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from mesh.base.clock import Clock


LOOK_INTERVAL: Final = 0.5
"""Seconds between two looks at who is late."""


class DoorLimits(NamedTuple):
    """What clients may use of a server."""

    connections: int = 512
    """Connections at once."""
    per_address: int = 64
    """Connections of one address at once (in IPv6, of one network of 64 bits)."""
    head: float = 10.0
    """Seconds for the TLS handshake and the head of a request."""
    idle: float = 75.0
    """Seconds between two requests on one connection."""
    grace: float = 10.0
    """Seconds in which a body may arrive at any pace."""
    pace: int = 32 << 10
    """Bytes a second that a body must have on average after that."""
    proxies: Collection[str] = ()
    """Addresses that may have any number of connections: many clients may come from one."""


class Guest:
    """One connection. What carries it says when a request began and ended, and how many bytes came."""

    __slots__ = ("_clock", "_is_idle", "_number", "address", "arrived", "close", "is_busy", "is_whole", "since")

    def __init__(self, address: str, close: Callable[[], object], clock: Clock) -> None:
        self.address = address
        self.close = close
        self._clock = clock
        self.is_busy = False
        """Whether a request is being answered; else the next one is waited for."""
        self.is_whole: Callable[[], bool] = _yes
        """Whether the request that is being answered has arrived with its whole body."""
        self._is_idle = False
        self._number = 0
        self.since = clock.monotonic()
        self.arrived = 0

    def received(self, size: int) -> None:
        """Some bytes came."""
        self.arrived += size
        if self._is_idle:
            self._is_idle = False
            self.since = self._clock.monotonic()

    def began(self, is_whole: Callable[[], bool] | None = None) -> int:
        """The head of a request has arrived, and it is being answered; with its body once `is_whole()`. Returns the
        number of the request."""
        self.is_busy, self._is_idle = True, False
        self.is_whole = is_whole or _yes
        self.since, self.arrived = self._clock.monotonic(), 0
        self._number += 1
        return self._number

    def ended(self, number: int) -> None:
        """The request of that number has been answered; the next one may have begun already."""
        if number != self._number:
            return
        self.is_busy, self._is_idle = False, True
        self.since = self._clock.monotonic()

    def is_late(self, limits: DoorLimits, now: float) -> bool:
        """Whether its next request, or the body of this one, takes too long."""
        took = now - self.since
        if not self.is_busy:
            return took > (limits.idle if self._is_idle else limits.head)
        return took > limits.grace and self.arrived < (took - limits.grace) * limits.pace and not self.is_whole()


class Door:
    """Who is connected to a server. Thread-safe."""

    def __init__(self, limits: DoorLimits, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self.limits = limits
        self._clock = clock
        self._lock = threading.Lock()
        self._guests: dict[Guest, None] = {}
        self._counts: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._guests)

    def enter(self, address: str, close: Callable[[], object]) -> Guest | None:
        """Let a connection in; `close` ends it. None if it must be closed, because all others ask something."""
        network = network_of(address)
        guest = Guest(network, close, self._clock)
        with self._lock:
            crowded = self._counts.get(network, 0) >= self.limits.per_address and address not in self.limits.proxies
            if crowded:
                leaving = self._longest_waiting(network)
            elif len(self._guests) >= self.limits.connections:
                leaving = self._longest_waiting(max(self._counts, key=self._counts.__getitem__))
                leaving = leaving or self._longest_waiting(None)
            else:
                leaving = guest
            if leaving is None:
                return None
            if leaving is not guest:
                self._remove(leaving)
            self._guests[guest] = None
            self._counts[network] = self._counts.get(network, 0) + 1
        if leaving is not guest:
            leaving.close()
        return guest

    def leave(self, guest: Guest) -> None:
        """A connection has ended."""
        with self._lock:
            self._remove(guest)

    def end_late(self) -> None:
        """Close the connections whose requests take too long."""
        now = self._clock.monotonic()
        with self._lock:
            late = [guest for guest in self._guests if guest.is_late(self.limits, now)]
        for guest in late:
            guest.close()

    async def run(self) -> None:
        """Do so again and again, until cancelled."""
        while True:
            await asyncio.sleep(LOOK_INTERVAL)
            self.end_late()

    def end_all(self) -> None:
        """Close all connections."""
        with self._lock:
            guests = list(self._guests)
        for guest in guests:
            guest.close()

    def _longest_waiting(self, network: str | None) -> Guest | None:
        """Of a network, or of all, the connection that has waited longest without a whole request."""
        waiting = (
            guest
            for guest in self._guests
            if network in (None, guest.address) and not (guest.is_busy and guest.is_whole())
        )
        return min(waiting, key=lambda guest: (guest.is_busy, guest.since), default=None)

    def _remove(self, guest: Guest) -> None:
        if guest in self._guests:
            del self._guests[guest]
            self._counts[guest.address] -= 1
            if not self._counts[guest.address]:
                del self._counts[guest.address]


@lru_cache(maxsize=4096)
def network_of(address: str) -> str:
    """What one client has: an IPv4 address, or an IPv6 network of 64 bits."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((int(parsed) >> 64 << 64, 64)))


def _yes() -> bool:
    return True

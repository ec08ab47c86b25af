"""A Zenoh session with a lifetime, which reports when the last router is lost and when one is back.

Measured with Zenoh 1.10: a client that finds no router raises at once; subscribers and queryables are restored after a
router's restart without our help; a session left open prevents the interpreter from exiting.

A router can also say whose its connections are and what they have sent, and close those of blocked sessions. Zenoh 1.10
offers no way to close a session of somebody else, and reads its access rules only when it starts. But the sockets are
in this process: shut down, they end their sessions at once. Only on Linux, and for connections over TCP.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import socket
import struct
from contextlib import suppress
from contextvars import copy_context
from enum import Enum
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import zenoh

from mesh.base.background import call_in_loop
from mesh.base.flood import HEAVIEST, REPORT_INTERVAL
from mesh.base.fresh_file import CHECK_INTERVAL, Blocklist
from mesh.base.log_context import log_event
from mesh.errors import ClosedError
from mesh.network import sending
from mesh.network.endpoints import Endpoints, SessionOpening
from mesh.telemetry.metrics import MetricFamily, counter, gauge
from schemas import parse_address
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Collection, Iterator

    from mesh.base.flood import Drops


log = logging.getLogger(__name__)

REPORTED: Final = 1024 * 1024
"""Bytes that a router receives between two reports, below which nothing is logged."""
DESCRIPTORS: Final = "/proc/self/fd"
TCP_INFO_SIZE: Final = 136
"""Bytes of Linux's `tcp_info` up to and with the number of received bytes, its last field there."""


class Connection(NamedTuple):
    """A connection of a session at this router."""

    session: str
    """Its Zenoh id, which clients choose."""
    name: str
    """The name in its certificate, on a site the address of a member; empty without one."""
    host: str
    """The IP address that it comes from."""
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.session} ({self.name + ' at ' if self.name else ''}{host}:{self.port})"


def connection_of(link: zenoh.Link) -> Connection | None:
    """The connection of a link; None if it is not over TCP."""
    protocol, _, address = link.dst.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in ("tcp", "tls", "ws") or not port.isdecimal():
        return None
    return Connection(str(link.zid), link.auth_identifier or "", host.strip("[]"), int(port))


def connections(session: zenoh.Session) -> list[Connection]:
    """The connections of a router's session. May take milliseconds."""
    return [found for link in session.info.links() if (found := connection_of(link)) is not None]


def close(unwanted: Collection[Connection]) -> int:
    """End connections; returns how many were found. May take milliseconds."""
    places, closed = {(each.host, each.port) for each in unwanted}, 0
    for place, each in _sockets():
        if place in places:
            with suppress(OSError):  # it has ended already
                each.shutdown(socket.SHUT_RDWR)
            closed += 1
    return closed


def received(known: Collection[Connection]) -> dict[Connection, int]:
    """Bytes received over each of these connections since it began. May take milliseconds."""
    by_place, found = {(each.host, each.port): each for each in known}, dict[Connection, int]()
    for place, each in _sockets():
        information = each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_SIZE)
        if place in by_place and len(information) == TCP_INFO_SIZE:
            (found[by_place[place]],) = struct.unpack_from("=Q", information, TCP_INFO_SIZE - 8)
    return found


def _sockets() -> Iterator[tuple[tuple[str, int], socket.socket]]:
    """The connected TCP sockets of this process, as duplicates, with the address of the other side.

    Zenoh says which links there are, but has no call that ends one, and does not count what it receives over it.
    """
    for name in os.listdir(DESCRIPTORS) if os.path.isdir(DESCRIPTORS) else ():
        with suppress(OSError):  # it is not connected, or was closed meanwhile
            if not os.readlink(f"{DESCRIPTORS}/{name}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(name))) as found:
                if found.family in (socket.AF_INET, socket.AF_INET6) and found.type == socket.SOCK_STREAM:
                    host, port, *_ = found.getpeername()
                    yield (host, port), found


class BlockedSessions:
    """The sessions that the file `path` blocks.

    A line is a Zenoh id, the address in a certificate, or the IP address or network (`192.0.2.0/24`) that sessions come
    from. Raises `ConfigurationError`.
    """

    def __init__(self, path: str | Path) -> None:
        self._list = Blocklist(Path(path).expanduser(), parse=parse_session)
        self._read: frozenset[str] = frozenset()
        self._networks: list[IPv4Network | IPv6Network] = []

    def changed(self) -> bool:
        """Read the file if it is time; whether it has changed since the last call."""
        before, self._read = self._read, self._list.entries
        if self._read is not before:
            self._networks = [ip_network(entry) for entry in self._read if "/" in entry]
        return self._read != before

    def __contains__(self, connection: Connection) -> bool:
        address = ip_address(connection.host)
        if isinstance(address, IPv6Address):
            address = address.ipv4_mapped or address
        names = {connection.session, connection.name.lower(), str(address)}
        return not self._read.isdisjoint(names) or any(address in network for network in self._networks)


def parse_session(text: str) -> str:
    """What names sessions, as it is compared. Raises `InputError` and `ValueError`."""
    text = text.lower()
    if text.startswith("0x"):
        return parse_address(text).lower()
    if re.fullmatch(r"[0-9a-f]{1,32}", text):  # a Zenoh id
        return text
    network = ip_network(text, strict=False)
    return str(network) if network.num_addresses > 1 else str(network.network_address)


async def guard(session: zenoh.Session, blocked: BlockedSessions, drops: Drops) -> None:
    """End the sessions at a router's `session` that are `blocked`, whenever they connect, until cancelled.

    Each end is counted in `drops`, by the address in the session's certificate or its IP address.
    """
    loop, new, arrived = asyncio.get_running_loop(), set[Connection](), asyncio.Event()

    def linked(event: zenoh.LinkEvent) -> None:
        found = connection_of(event.link) if event.kind == zenoh.SampleKind.PUT else None
        if found is not None and found in blocked:
            new.add(found)
            arrived.set()

    await asyncio.to_thread(blocked.changed)
    listener: Any = session.info.declare_link_events_listener(
        lambda event: call_in_loop(loop, linked, event), history=True
    )
    try:
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(CHECK_INTERVAL):
                    await arrived.wait()
            arrived.clear()
            if await asyncio.to_thread(blocked.changed):
                new.update(each for each in await asyncio.to_thread(connections, session) if each in blocked)
            if new:
                unwanted = frozenset(new)
                new.clear()
                await asyncio.to_thread(close, unwanted)
                for each in unwanted:
                    drops.count("blocked-session", each.name or each.host)
                await asyncio.sleep(0.05)  # blocked sessions may connect again and again
    finally:
        if not session.is_closed():
            listener.undeclare()


async def report_traffic(session: zenoh.Session, *, interval: float = REPORT_INTERVAL, least: int = REPORTED) -> None:
    """Log at each interval (seconds) which sessions sent most to this router, if it received `least` bytes."""
    before: dict[Connection, int] = {}
    while True:
        await asyncio.sleep(interval)
        now = await asyncio.to_thread(lambda: received(connections(session)))
        new = {each: number - before.get(each, 0) for each, number in now.items()}
        before, total = now, sum(new.values())
        if total >= least:
            heaviest = sorted(new, key=new.__getitem__, reverse=True)[:HEAVIEST]
            most = ", ".join(f"{each} {new[each] / 1e6:.1f} MB" for each in heaviest)
            facts = log_event("traffic-reported", bytes=total, heaviest=most)
            log.info("received %.1f MB in the last %d s, most from %s", total / 1e6, interval, most, extra=facts)


class NetworkChange(Enum):
    """A change of the session's connection to the mesh."""

    LOST = "lost"
    """The last router was lost. Messages published now vanish; send them again."""
    REGAINED = "regained"
    """A router is connected again, and Zenoh has restored subscribers, queryables and tokens."""


class Network:
    """A Zenoh session with a lifetime: `async with Network(endpoints) as network`.

    Opening and closing run in a thread, since both may block. Cancelling during opening takes effect at once; the
    thread ends after its current attempt, within seconds, and closes the session if that succeeds. Raises
    `RemoteError` (`NetworkUnavailable`, `not-admitted`) or `ConfigurationError` when it can't be opened.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._session: zenoh.Session | None = None
        self._watchers: set[asyncio.Queue[NetworkChange]] = set()
        self._linked: set[str] = set()
        self.losses = 0
        """How often the last router was lost."""
        self._listener: Any = None

    @property
    def session(self) -> zenoh.Session:
        """The open session. Raises `ClosedError` outside `async with`."""
        if self._session is None:
            raise ClosedError("the network session is not open", hint="use it inside `async with`")
        return self._session

    @property
    def id(self) -> str:
        """The session's Zenoh id, as routers and peers report it."""
        return str(self.session.zid())

    @property
    def connected(self) -> bool:
        """Whether a router is connected now. A session in mode `router` is connected while it is open."""
        return self._session is not None and (self._endpoints.mode == "router" or bool(self._linked))

    @property
    def links(self) -> int:
        """The number of connected routers; for a router, of its clients as well."""
        return len(self._linked)

    @property
    def state(self) -> str:
        """Its health as a part of a role."""
        return ALIVE if self.connected else "waits for a router"

    def families(self) -> tuple[MetricFamily, ...]:
        """The metrics of the connection."""
        return (
            gauge("aira_network_links", "Connected routers; for a router, all sessions connected to it", self.links),
            counter("aira_network_losses_total", "How often the last connected router was lost", self.losses),
        )

    async def __aenter__(self) -> Self:
        if self._session is not None:
            raise ClosedError("this network session is already open")
        opening = SessionOpening(self._endpoints)
        try:
            session = await asyncio.to_thread(opening.run)
            self._watch(session)
        except BaseException:
            opening.abandon()
            raise
        self._session = session
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        session, self._session = self._session, None
        self._linked.clear()
        if session is not None:
            sending.forget(session)
            await asyncio.to_thread(session.close)

    def _watch(self, session: zenoh.Session) -> None:
        """Follow the links. The current ones are read after the listener is declared, so that none is missed."""
        loop, context = asyncio.get_running_loop(), copy_context()
        self._listener = session.info.declare_transport_events_listener(
            lambda event: call_in_loop(loop, self._transport_changed, event, context=context), history=True
        )
        self._linked = {str(zid) for zid in session.info.routers_zid()}

    def _transport_changed(self, event: zenoh.TransportEvent) -> None:
        if self._session is None:
            return
        before = self.connected
        change_links = self._linked.add if event.kind == zenoh.SampleKind.PUT else self._linked.discard
        change_links(str(event.transport.zid))
        if self.connected == before:
            return
        change = NetworkChange.REGAINED if self.connected else NetworkChange.LOST
        self.losses += change is NetworkChange.LOST
        # Not a warning: commands report the loss themselves.
        if self.connected:
            log.info("the router is back", extra=log_event("router-regained"))
        else:
            log.info("lost the router; waiting for it", extra=log_event("router-lost", losses=self.losses))
        for queue in self._watchers:
            queue.put_nowait(change)

    async def changes(self) -> AsyncGenerator[NetworkChange, None]:
        """Yield each loss and return of the network from now on. Ends by cancellation or `aclose`."""
        queue: asyncio.Queue[NetworkChange] = asyncio.Queue()
        self._watchers.add(queue)
        try:
            while True:
                yield await queue.get()
        finally:
            self._watchers.discard(queue)

"""One Zenoh session: opened by settings, closed for certain, with news of the network's loss and return.

Source of the rules: the project's measurements of Zenoh 1.10 (a client that finds no router raises at once unless it
is told to wait; subscribers and queryables come back unaided after a router's restart; a session left open keeps the
interpreter from ending).
"""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import zenoh

from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from types import TracebackType

log = logging.getLogger(__name__)

RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
"""Pauses between attempts to reach a router again: short, so that an agent is back within a second."""


class NetworkChange(Enum):
    """What happened to the session's link to the mesh."""

    LOST = "lost"
    """The last router is gone. What is published now vanishes; keep it and send it again."""
    REGAINED = "regained"
    """A router answers again; subscribers, queryables and tokens have been declared anew by Zenoh."""


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    """Where a session goes, and as what.

    `connect` and `listen` are Zenoh locators (`tcp/HOST:PORT`). `mode` is `client` for agents, `router` for the
    process that holds the market together. `timeout` is in seconds; -1 waits for ever.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Literal["client", "router"] = "client"
    timeout: float = 10.0

    def config(self) -> zenoh.Config:
        """The Zenoh configuration. Raises `ConfigurationError` for a locator that Zenoh would silently not use."""
        for locator in (*self.connect, *self.listen):
            if "/" not in locator or not locator.split("/", 1)[1]:
                raise ConfigurationError(
                    f"{locator!r} is not a Zenoh endpoint",
                    hint="write it as tcp/HOST:PORT, for instance tcp/127.0.0.1:7447",
                )
        options: dict[str, object] = {
            "mode": self.mode,
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/timeout_ms": int(self.timeout * 1000) if self.timeout >= 0 else -1,
            "connect/retry": RETRY,
            "scouting/multicast/enabled": False,
        }
        config = zenoh.Config()
        for path, value in options.items():
            config.insert_json5(path, json.dumps(value))
        return config


class Network:
    """A Zenoh session with a lifetime: `async with Network(endpoints) as network`.

    Opening and closing run in a thread, since both may block. Cancelling while it opens waits for the attempt to end
    and closes what came of it.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._session: zenoh.Session | None = None
        self._watchers: set[asyncio.Queue[NetworkChange]] = set()
        self._linked: set[str] = set()
        self._listener: Any = None

    @property
    def session(self) -> zenoh.Session:
        """The open session. Raises `ClosedError` outside `async with`."""
        if self._session is None:
            raise ClosedError("the network session is not open", hint="use it inside `async with`")
        return self._session

    @property
    def id(self) -> str:
        """The session's Zenoh id, as routers and peers show it."""
        return str(self.session.zid())

    @property
    def connected(self) -> bool:
        """Whether a router is reachable now (a router itself always is)."""
        return self._endpoints.mode == "router" or bool(self._linked)

    async def __aenter__(self) -> Self:
        if self._session is not None:
            raise ClosedError("this network session is open already")
        config = self._endpoints.config()
        opening = asyncio.ensure_future(asyncio.to_thread(self._open, config))
        try:
            self._session = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_unwanted)
            raise
        loop = asyncio.get_running_loop()
        self._linked = {str(zid) for zid in self._session.info.routers_zid()}
        self._listener = self._session.info.declare_transport_events_listener(
            lambda event: _call(loop, self._transport_changed, event), history=True
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        session, self._session = self._session, None
        if session is not None:
            await asyncio.to_thread(session.close)

    def _open(self, config: zenoh.Config) -> zenoh.Session:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise self._explained(error) from None

    def _explained(self, error: zenoh.ZError) -> NetworkUnavailable | ConfigurationError:
        why = str(error).split(" at ", 1)[0]
        if self._endpoints.listen and not self._endpoints.connect:
            where = ", ".join(self._endpoints.listen)
            return ConfigurationError(
                f"can't listen at {where}: {why}", hint="is the port taken? give another with --listen tcp/HOST:PORT"
            )
        return NetworkUnavailable(self._endpoints.connect, why)

    def _transport_changed(self, event: zenoh.TransportEvent) -> None:
        before = self.connected
        change_links = self._linked.add if event.kind == zenoh.SampleKind.PUT else self._linked.discard
        change_links(str(event.transport.zid))
        if self.connected == before:
            return
        change = NetworkChange.REGAINED if self.connected else NetworkChange.LOST
        log.info("network %s", change.value)
        for queue in self._watchers:
            queue.put_nowait(change)

    async def changes(self) -> AsyncIterator[NetworkChange]:
        """Each loss and return of the network from now on, in order. Ends only by cancellation or `aclose`."""
        queue: asyncio.Queue[NetworkChange] = asyncio.Queue()
        self._watchers.add(queue)
        try:
            while True:
                yield await queue.get()
        finally:
            self._watchers.discard(queue)


def _call(loop: asyncio.AbstractEventLoop, function: Any, argument: object) -> None:
    """Hand `function(argument)` to the loop from a Zenoh thread, unless the loop has ended meanwhile."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, argument)


def _close_unwanted(opening: asyncio.Future[zenoh.Session]) -> None:
    """Close a session whose opener was cancelled before it came."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()  # type: ignore[no-untyped-call]


def free_endpoint() -> str:
    """A loopback TCP locator whose port was free a moment ago, for a router inside this process."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

"""A Zenoh session with a lifetime, which reports when the last router is lost and when one is back.

Measured with Zenoh 1.10: a client that finds no router raises at once; subscribers and queryables are restored after a
router's restart without our help; a session left open prevents the interpreter from exiting.
"""

from __future__ import annotations

import asyncio
import logging
from contextvars import copy_context
from enum import Enum
from typing import TYPE_CHECKING, Any, Self

import zenoh

from mesh.background import call_in_loop
from mesh.errors import ClosedError
from mesh.log_context import log_event
from mesh.network import sending
from mesh.network.connecting import SessionOpening

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from mesh.network.endpoints import Endpoints

log = logging.getLogger(__name__)


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
    `NetworkUnavailable`, `NotAdmitted` or `ConfigurationError` when it can't be opened.
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

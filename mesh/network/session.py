"""One Zenoh session: opened by settings, closed for certain, with news of the network's loss and return.

Source of the rules: the project's measurements of Zenoh 1.10 (a client that finds no router raises at once unless it
is told to wait; subscribers and queryables come back unaided after a router's restart; a session left open keeps the
interpreter from ending).
"""

from __future__ import annotations

import asyncio
import logging
from contextvars import copy_context
from enum import Enum
from typing import TYPE_CHECKING, Any, Self

import zenoh

from mesh.errors import ClosedError
from mesh.network.crossing import call_in_loop
from mesh.network.opening import Opening

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from types import TracebackType

    from mesh.network.endpoints import Endpoints

log = logging.getLogger(__name__)


class NetworkChange(Enum):
    """What happened to the session's link to the mesh."""

    LOST = "lost"
    """The last router is gone. What is published now vanishes; keep it and send it again."""
    REGAINED = "regained"
    """A router answers again; subscribers, queryables and tokens have been declared anew by Zenoh."""


class Network:
    """A Zenoh session with a lifetime: `async with Network(endpoints) as network`.

    Opening and closing run in a thread, since both may block. Cancelling while it opens takes effect at once; the
    thread ends with its attempt, some seconds later at most, and closes what came of it.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._session: zenoh.Session | None = None
        self._watchers: set[asyncio.Queue[NetworkChange]] = set()
        self._linked: set[str] = set()
        self.losses = 0
        """How often the network was lost since the session was made."""
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
        """Whether a router is reachable now (a router itself always is, as long as it is open)."""
        return self._session is not None and (self._endpoints.mode == "router" or bool(self._linked))

    @property
    def links(self) -> int:
        """To how many others the session is linked: routers, or for a router its clients as well."""
        return len(self._linked)

    async def __aenter__(self) -> Self:
        if self._session is not None:
            raise ClosedError("this network session is open already")
        opening = Opening(self._endpoints)
        try:
            session = await asyncio.to_thread(opening.run)
            self._watch(session)
        except BaseException:
            opening.abandon()
            raise
        self._session = session
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        session, self._session = self._session, None
        self._linked.clear()
        if session is not None:
            await asyncio.to_thread(session.close)

    def _watch(self, session: zenoh.Session) -> None:
        """Follow the links. Those of now are read once the listener is there, so that none is missed in between."""
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
        # No warning: commands say it in their own words.
        log.info("a router is there again" if self.connected else "the router is gone; waiting for it")
        for queue in self._watchers:
            queue.put_nowait(change)

    async def changes(self) -> AsyncGenerator[NetworkChange, None]:
        """Each loss and return of the network since the iteration began, in order. Ends by cancellation or `aclose`."""
        queue: asyncio.Queue[NetworkChange] = asyncio.Queue()
        self._watchers.add(queue)
        try:
            while True:
                yield await queue.get()
        finally:
            self._watchers.discard(queue)

"""The stream: events with sequence numbers, to the WebSockets that subscribed to their topics.

The last events are kept, so that a browser whose connection broke goes on where it was; live values are not, and who
resumes with their topics gets a `gap`. A connection that reads more slowly than events come loses its oldest live
values and market events, and then gets one event `lost` with their number; its memory is bounded.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from aiohttp import WSMsgType, web

from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class EventLimits(NamedTuple):
    """Events that wait for connections."""

    kept: int = 8192
    """Those that are kept for connections that resume …"""
    kept_size: int = 16 << 20
    """… and their bytes."""
    waiting: int = 1024
    """Those that wait for one connection …"""
    waiting_size: int = 4 << 20
    """… and their bytes."""


EVENT_LIMITS: Final = EventLimits()
MARKET: Final = "market"
LIVE: Final = ("live/", "readings/")
"""How the topics of live values begin. They are not kept."""


class StreamEvent(NamedTuple):
    """An event, encoded once for all connections."""

    seq: int
    topic: str
    text: bytes


class StreamRequest(msgspec.Struct, frozen=True):
    """What a browser sends."""

    subscribe: list[str]
    after: int | None = None
    stream: str = ""


class Stream:
    """The events of one server. Used in one event loop."""

    def __init__(self) -> None:
        self.id: Final = secrets.token_hex(8)
        self._kept: deque[StreamEvent] = deque()
        self._bytes = 0
        self._connections: set[StreamConnection] = set()
        self.seq = 0
        self._closed = False
        self.on_subscribe: Callable[[frozenset[str]], object] = lambda _topics: None
        """Called with the topics that a connection has subscribed to."""

    def publish(self, topic: str, kind: str, data: Any) -> None:
        """Send an event to those who subscribed to its topic."""
        self.seq += 1
        body = {"seq": self.seq, "topic": topic, "kind": kind, "data": data, "at": time.time()}
        event = StreamEvent(self.seq, topic, msgspec.json.encode(body))
        if not topic.startswith(LIVE):
            self._kept.append(event)
            self._bytes += len(event.text)
        while len(self._kept) > EVENT_LIMITS.kept or self._bytes > EVENT_LIMITS.kept_size:
            self._bytes -= len(self._kept.popleft().text)
        for connection in self._connections:
            connection.offer(event)

    def has_subscribers(self, topic: str) -> bool:
        return any(topic in connection.topics for connection in self._connections)

    def since(self, seq: int) -> Iterator[StreamEvent] | None:
        """The kept events after `seq`; None if some of them are no longer kept."""
        first = self._kept[0].seq if self._kept else self.seq + 1
        if not first - 1 <= seq <= self.seq:
            return None
        return (event for event in list(self._kept) if event.seq > seq)

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Serve one connection until it ends."""
        socket = web.WebSocketResponse(heartbeat=20.0, max_msg_size=65_536, compress=False)
        await socket.prepare(request)
        if self._closed:  # while this connection was being made
            await socket.close(code=1001, message=b"the server stops")
            return socket
        if len(self._connections) >= 256:
            await socket.close(code=1013, message=b"too many connections")
            return socket
        connection = StreamConnection(self, socket)
        self._connections.add(connection)
        sending = asyncio.create_task(connection.send(), name="page stream")
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT or not connection.subscribe(message.data):
                    break
        finally:
            self._connections.discard(connection)
            sending.cancel()
            await asyncio.wait((sending,))
            await socket.close()
        return socket

    def event(self, kind: str, data: Any) -> bytes:
        """An event of the connection itself, with the current sequence number."""
        return msgspec.json.encode({"seq": self.seq, "kind": kind, "data": data, "at": time.time()})

    async def close(self) -> None:
        """End all connections, and those that are still being made: the server stops."""
        self._closed = True
        for connection in list(self._connections):
            with suppress(ConnectionError):
                await connection.socket.close(code=1001, message=b"the server stops")


class StreamConnection:
    """One WebSocket: what it subscribed to, and what waits for it."""

    def __init__(self, stream: Stream, socket: web.WebSocketResponse) -> None:
        self._stream = stream
        self.socket = socket
        self.topics: frozenset[str] = frozenset()
        self._waiting: deque[StreamEvent] = deque()
        self._bytes = 0
        self._first: deque[bytes] = deque()
        self._lost = 0
        self._ready = asyncio.Event()

    def subscribe(self, text: str) -> bool:
        """Take a request; False if it is none."""
        try:
            wanted = decode_json(text, StreamRequest)
        except InvalidData:
            return False
        if len(wanted.subscribe) > 256:  # topics that one connection may subscribe to
            return False
        self.topics = frozenset(wanted.subscribe)
        self._first.append(self._stream.event("hello", {"stream": self._stream.id, "seq": self._stream.seq}))
        if wanted.after is not None:
            missed = self._stream.since(wanted.after) if wanted.stream == self._stream.id else None
            if missed is None or any(topic.startswith(LIVE) for topic in self.topics):
                self._first.append(self._stream.event("gap", {}))
            self._waiting.clear()
            self._bytes = 0
            for event in missed or ():
                self.offer(event)
        self._ready.set()
        self._stream.on_subscribe(self.topics)
        return True

    def offer(self, event: StreamEvent) -> None:
        """Queue an event, if its topic is wanted. Of too many, the oldest of the market or of live values is dropped,
        else the oldest."""
        if event.topic not in self.topics:
            return
        while self._waiting and (
            len(self._waiting) >= EVENT_LIMITS.waiting or self._bytes + len(event.text) > EVENT_LIMITS.waiting_size
        ):
            streamed = (waiting for waiting in self._waiting if waiting.topic.startswith((MARKET, *LIVE)))
            oldest = next(streamed, self._waiting[0])
            self._waiting.remove(oldest)
            self._bytes -= len(oldest.text)
            self._lost += 1
        self._waiting.append(event)
        self._bytes += len(event.text)
        self._ready.set()

    async def send(self) -> None:
        """Send what waits, many events in a frame, until cancelled."""
        with suppress(ConnectionError):
            while True:
                await self._ready.wait()
                self._ready.clear()
                texts = list(self._first)
                self._first.clear()
                if self._lost:
                    texts.append(self._stream.event("lost", {"count": self._lost}))
                    self._lost = 0
                # Events in one frame.
                some = [self._waiting.popleft().text for _ in range(min(128, len(self._waiting)))]
                self._bytes -= sum(map(len, some))
                texts += some
                if self._waiting:
                    self._ready.set()
                if texts:
                    await self.socket.send_str((b"[" + b",".join(texts) + b"]").decode())
                await asyncio.sleep(0.05)  # seconds between two frames to one connection: more events come together

"""What Foxglove connects to: a front that checks clients, and behind it a server of the Foxglove SDK.

The SDK's server checks nobody: it listens on an address of this machine only. The front checks each request (site,
token), bounds the clients and what each of them sends, ends those that don't read, and offers TLS. Everything else it
carries unchanged. The server has a channel for each topic and type; messages get a form that Foxglove decodes: with a
schema, and JSON whose root is an object.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import random
import time
from collections import OrderedDict, deque
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import aiohttp
import msgspec
from aiohttp import web
from foxglove import Context, Schema, start_server
from foxglove.websocket import Capability, ServerListener

from bridges.serving import ServerOptions, is_loopback
from mesh import foxglove
from mesh.base.background import Background, call_in_loop
from mesh.base.door import DoorLimits, network_of
from mesh.base.extras import PackageMissing
from mesh.base.flood import Rate, RateLimiter
from mesh.base.http_server import HttpServer
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.recording import JsonSchemas, encode_described
from mesh.recording.ros import NOETIC, RosTypes, UnknownRosType
from schemas.payloads import EMPTY, RAW, PayloadType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AsyncExitStack

    from foxglove.websocket import ChannelView, Client, PlaybackControlRequest, PlaybackState

    from mesh.base.flood import Drops


log = logging.getLogger(__name__)

APPS: Final = ("https://app.foxglove.dev", "file://")
"""The sites that may connect: Foxglove in the browser, and applications that are no site."""


@dataclass(frozen=True, kw_only=True)
class FoxgloveOptions(ServerOptions):
    """How Foxglove is served. A client shows the token at the end of the address: `?token=…`."""

    origins: tuple[str, ...] = ()
    """Other sites than `APPS` that may connect."""


class ViewerLimits(NamedTuple):
    """What the clients may use of the front."""

    clients: int = 16
    """Clients at a time."""
    message: int = 1 << 18
    """Bytes of one message of a client: it subscribes to topics, and controls the playback."""
    pace: int = 1 << 16
    """Bytes a second that a client must take of a long message."""


VIEWER_LIMITS: Final = ViewerLimits()
LIMITS: Final = DoorLimits(connections=256, head=5.0)
"""With the connections whose request is not read yet."""
SENT: Final = Rate(per_second=1 << 16, burst=4 * VIEWER_LIMITS.message)
"""Bytes that one client sends; beyond, the front waits before it reads more."""


class FoxgloveFront(Lifecycle):
    """`async with FoxgloveFront(options, drops) as front`, then `front.url`; `front.inner` is the address of the SDK's
    server, empty while there is none."""

    title = "front of the Foxglove server"
    stalled: float = 5.0
    """Seconds, besides those by `VIEWER_LIMITS`, in which a client must take a message, or it is disconnected."""

    def __init__(self, options: FoxgloveOptions, drops: Drops) -> None:
        options.check()
        self._options = options
        self.drops: Final = drops
        self._limiter = RateLimiter(per_sender=Rate(per_second=1.0, burst=20))
        self._opening = asyncio.Lock()
        self.clients = 0
        """How many are connected."""
        self.inner = ""
        self.url = ""

    async def _open(self, stack: AsyncExitStack) -> None:
        options = self._options
        tls = await asyncio.to_thread(options.tls)
        self._http = await stack.enter_async_context(aiohttp.ClientSession())
        app = web.Application()
        app.router.add_route("*", "/{path:.*}", self._serve)
        server = HttpServer(app, options.host, options.port, tls=tls, limits=LIMITS, option="--listen HOST:PORT")
        await stack.enter_async_context(server)
        host = f"[{options.host}]" if ":" in options.host else options.host
        self.url = f"{'ws' if tls is None else 'wss'}://{host}:{server.port}"

    async def _serve(self, request: web.Request) -> web.StreamResponse:
        address = request.remote or ""
        try:
            self._check(request, address)
            self.clients += 1
            try:
                return await self._carry(request, address)
            finally:
                self.clients -= 1
        except web.HTTPException as refused:
            self._refused(address, refused.text or "")
            refused.headers["X-Content-Type-Options"] = "nosniff"
            refused.force_close()
            raise

    def _refused(self, address: str, why: str) -> None:
        self.drops.count("foxglove-refused", address)
        log.debug(
            "refused a client at %s: %s", address, why, extra=log_event("foxglove-refused", address=address, why=why)
        )

    def _check(self, request: web.Request, address: str) -> None:
        """Raise an answer for a page of another site, a client without the token, and one too many."""
        headers, options = request.headers, self._options
        if request.method != "GET" or headers.get("Upgrade", "").lower() != "websocket":
            raise web.HTTPUpgradeRequired(text="this is a server for Foxglove: open a connection there, to ws://…")
        origin = headers.get("Origin")
        if origin is not None and origin not in (*APPS, *options.origins):
            raise web.HTTPForbidden(text="pages of this site may not connect; name it with --origin")
        if options.token:
            given = request.query.get("token") or headers.get("Authorization", "").removeprefix("Bearer ")
            if not hmac.compare_digest(given.encode(errors="replace"), options.token.encode()):
                raise web.HTTPUnauthorized(text="add the token to the address: ?token=…")
        if not is_loopback(address) and not self._limiter.allow(network_of(address)):
            raise web.HTTPTooManyRequests(text="too many connections; wait a moment")
        if not self.inner:
            raise web.HTTPServiceUnavailable(text="nothing is shown yet")
        if self.clients >= VIEWER_LIMITS.clients:
            raise web.HTTPServiceUnavailable(text=f"there are {VIEWER_LIMITS.clients} clients already")

    async def _carry(self, request: web.Request, address: str) -> web.StreamResponse:
        """Serve one client until it or the SDK's server ends."""
        offered = [name.strip() for name in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        try:
            # The SDK numbers clients and their sinks apart; the numbers are equal if clients come one after another.
            async with self._opening, asyncio.timeout(LIMITS.head):
                inner = await self._http.ws_connect(self.inner, protocols=offered, max_msg_size=0)
                greeting = await inner.receive()
        except (aiohttp.ClientError, TimeoutError) as error:
            log.debug("the SDK's server refuses a client at %s: %s", address, error)
            raise web.HTTPBadRequest(text="a connection of Foxglove needs its subprotocol, foxglove.sdk.v1") from None
        socket = web.WebSocketResponse(
            protocols=(inner.protocol,) if inner.protocol else (),
            max_msg_size=VIEWER_LIMITS.message,
            compress=False,
            timeout=1.0,
        )
        try:
            async with inner, Background() as tasks:
                await socket.prepare(request)
                tasks.start(self._send(socket, inner, address), "foxglove client sends")
                await self._receive(inner, socket, greeting)
                await socket.close()
        except (OSError, TimeoutError) as error:
            log.debug("a client at %s is gone: %s", address, error)
            if request.transport is not None:
                request.transport.abort()
        return socket

    async def _send(self, socket: web.WebSocketResponse, inner: aiohttp.ClientWebSocketResponse, address: str) -> None:
        """Carry what a client sends, at a bounded rate, until it closes the connection."""
        limiter = RateLimiter(per_sender=SENT)
        async for message in socket:
            if message.type is aiohttp.WSMsgType.ERROR:
                self._refused(address, str(message.data))
                break
            while not limiter.allow("", len(message.data)):  # noqa: ASYNC110 - nothing else happens then
                await asyncio.sleep(0.1)
            await _pass_on(message, inner)
        await inner.close()

    async def _receive(
        self, inner: aiohttp.ClientWebSocketResponse, socket: web.WebSocketResponse, message: aiohttp.WSMessage
    ) -> None:
        """Carry what the SDK's server sends, until it ends. Raises `TimeoutError` for a client that does not read."""
        while message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT):
            async with asyncio.timeout(self.stalled + len(message.data) / VIEWER_LIMITS.pace):
                await _pass_on(message, socket)
            message = await inner.receive()


async def _pass_on(message: aiohttp.WSMessage, to: web.WebSocketResponse | aiohttp.ClientWebSocketResponse) -> None:
    if message.type is aiohttp.WSMsgType.BINARY:
        await to.send_bytes(message.data)
    else:
        await to.send_str(message.data)


ROS2: Final = "jazzy"
"""The distribution of ROS 2 whose definitions are used for types that came without one."""


class ShownLimits(NamedTuple):
    """What the server shows and keeps for its clients."""

    channels: int = 512
    """Channels at a time; beyond, the one that was not used for longest is closed."""
    topic: int = 256
    """Characters of a topic."""
    message: int = 4 << 20
    """Bytes of the largest message that is shown."""
    kept: int = 50
    """The last messages of a channel, which are repeated to those who subscribe later …"""
    kept_size: int = 1 << 16
    """… and their bytes."""
    definitions: int = 1024
    """Types whose definition is remembered."""


SHOWN_LIMITS: Final = ShownLimits()
_IMAGES: Final = ((b"\x89PNG\r\n\x1a\n", "png"), (b"\xff\xd8\xff", "jpeg"))


class Bytes(msgspec.Struct, frozen=True):
    """A message that can't be decoded: how many bytes it has, and the first of them."""

    type: str
    size: int
    data: bytes


Shown: TypeAlias = tuple[bytes, PayloadType]
"""A message as Foxglove gets it. The type has a definition, or is the empty one."""


class ShownTypes:
    """Gives the messages of one view their form. `known` are types of which only the name travels with a message.

    The first one reads the types of ROS: use a thread.
    """

    def __init__(self, known: tuple[PayloadType, ...] = ()) -> None:
        self._json = JsonSchemas()
        self._ros = _ros_types()
        self._defined: dict[tuple[str, str], PayloadType | None] = {}
        for kind in known:
            if kind.schema_data:
                self._learn(kind)

    def shown(self, topic: str, payload: bytes, kind: PayloadType) -> Shown:
        if kind.encoding == "json":
            return self._object(topic, payload, kind)
        if kind == EMPTY or kind.schema_data:
            self._learn(kind)
            return payload, kind
        if (defined := self._definition(kind)) is not None:
            return payload, defined
        for magic, name in _IMAGES:
            if payload.startswith(magic):
                return encode_described(foxglove.CompressedImage(data=payload, format=name))
        return encode_described(Bytes("" if kind == RAW else kind.zenoh_encoding, len(payload), payload[:4096]))

    def _learn(self, kind: PayloadType) -> None:
        """Remember the definition of a type for messages that come without it."""
        name = kind.encoding, kind.schema_name
        if self._defined.get(name) is None and len(self._defined) < SHOWN_LIMITS.definitions:
            self._defined[name] = kind

    def _object(self, topic: str, payload: bytes, kind: PayloadType) -> Shown:
        """JSON with an object at its root: other data is the value of the property `value`."""
        if payload.lstrip(b" \t\r\n")[:1] != b"{":
            payload, kind = b'{"value":' + payload + b"}", PayloadType("json", "", "jsonschema")
        return payload, self._json.describe(topic, payload, kind)

    def _definition(self, kind: PayloadType) -> PayloadType | None:
        """The type with its definition, if that is known or if ROS has one."""
        name = kind.encoding, kind.schema_name
        if name not in self._defined and len(self._defined) < SHOWN_LIMITS.definitions:
            self._defined[name] = None
            with suppress(UnknownRosType):
                if kind.encoding in self._ros and kind.schema_name:
                    self._defined[name] = self._ros[kind.encoding].payload_type(kind.schema_name)
        return self._defined.get(name)


@cache
def _ros_types() -> Mapping[str, RosTypes]:
    """The types of ROS by encoding; none without the package rosbags."""
    try:
        return {"ros1": RosTypes(NOETIC), "cdr": RosTypes(ROS2)}
    except PackageMissing:
        return {}


NEW_CHANNELS: Final = Rate(per_second=4.0, burst=128)
"""New channels of one sender: clients learn of each."""
NEW_CHANNELS_IN_TOTAL: Final = Rate(per_second=16.0, burst=SHOWN_LIMITS.channels)
# The SDK logs a line for each mistake of a client.
logging.getLogger("foxglove").setLevel(logging.CRITICAL)


class OpenChannel:
    """A channel of the SDK, and the last messages on it as they came: payload, type, time."""

    def __init__(self, name: str, source: ChannelSource, channel: Any, shown: PayloadType) -> None:
        self.name = name
        self.source = source
        self.channel = channel
        self.shown = shown
        self.last: deque[tuple[bytes, PayloadType, int]] = deque()
        self.size = 0

    def keep(self, payload: bytes, kind: PayloadType, at_ns: int) -> None:
        self.last.append((payload, kind, at_ns))
        self.size += len(payload)
        while len(self.last) > SHOWN_LIMITS.kept or self.size > SHOWN_LIMITS.kept_size:
            self.size -= len(self.last.popleft()[0])


class ChannelSource(NamedTuple):
    """Messages of one type on one topic."""

    topic: str
    encoding: str
    schema: str


class PlaybackControl(NamedTuple):
    """The time range of a recording (ns), and what answers requests of clients, on a thread of the SDK."""

    start_ns: int
    end_ns: int
    answer: Callable[[PlaybackControlRequest], PlaybackState]


class FoxgloveServer(Lifecycle):
    """`async with FoxgloveServer(front, name) as server`, then `server.publish`. Used in one event loop.

    `known` are types of which only the name travels with a message. With `control` clients control a playback.
    """

    title = "Foxglove server"

    def __init__(
        self,
        front: FoxgloveFront,
        name: str,
        *,
        known: tuple[PayloadType, ...] = (),
        control: PlaybackControl | None = None,
    ) -> None:
        self.front = front
        self._name = name
        self._known = known
        self._control = control
        self._channels: OrderedDict[ChannelSource, OpenChannel] = OrderedDict()
        self._names: set[str] = set()
        self._by_id: dict[int, OpenChannel] = {}
        self._limiter = RateLimiter(per_sender=NEW_CHANNELS, total=NEW_CHANNELS_IN_TOTAL)
        self._context = Context()

    async def _open(self, stack: AsyncExitStack) -> None:
        loop = asyncio.get_running_loop()
        self._types = await asyncio.to_thread(ShownTypes, self._known)
        # A page of another site that searches the ports of 127.0.0.1 does not find it here.
        host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
        control = self._control
        self.sdk = start_server(
            name=self._name,
            host=host,
            port=0,
            context=self._context,
            server_listener=_Listener(partial(call_in_loop, loop, self.repeat_last), control),
            capabilities=[] if control is None else [Capability.PlaybackControl, Capability.Time],
            playback_time_range=None if control is None else (control.start_ns, control.end_ns),
            message_backlog_size=256,
        )
        stack.push_async_callback(self._end)
        """The SDK's server, which broadcasts the time and the state of a playback."""
        self.front.inner = f"ws://{host}:{self.sdk.port}/"

    async def _end(self) -> None:
        self.front.inner = ""
        await asyncio.to_thread(self.sdk.stop)

    def publish(
        self, topic: str, payload: bytes, kind: PayloadType, *, at_ns: int | None = None, sender: str = ""
    ) -> None:
        """Show a message on a topic, received at that Unix time (ns; None: now).

        Messages of several types on one topic appear as several topics. What is too large or on too many topics is
        dropped, and counted by `sender`.
        """
        if len(payload) > SHOWN_LIMITS.message:
            self.front.drops.count("foxglove-too-large", sender)
            return
        source = ChannelSource(topic[: SHOWN_LIMITS.topic], kind.encoding, kind.schema_name)
        known = self._channels.get(source)
        at = time.time_ns() if at_ns is None else at_ns
        if known is None or known.channel.has_sinks():
            shown, shown_as = self._types.shown(source.topic, payload, kind)
            known = self._channel_for(source, shown_as, sender)
            if known is None:
                self.front.drops.count("foxglove-topics", sender)
                return
            known.channel.log(shown, log_time=at)
        known.keep(payload, kind, at)

    def announce(self, topics: Iterable[tuple[str, PayloadType]]) -> None:
        """Let clients know of topics before there are messages, if their types have a schema: as many as channels."""
        for topic, kind in islice(topics, SHOWN_LIMITS.channels):
            if kind.schema_data or kind == EMPTY:
                source = ChannelSource(topic[: SHOWN_LIMITS.topic], kind.encoding, kind.schema_name)
                self._opened(source, kind)

    def publish_value(self, topic: str, value: Any, *, at_ns: int | None = None, sender: str = "") -> None:
        """Show data as JSON, or a message of `mesh.recording.foxglove`."""
        payload, kind = encode_described(value)
        self.publish(topic, payload, kind, at_ns=at_ns, sender=sender)

    def _channel_for(self, source: ChannelSource, kind: PayloadType, sender: str) -> OpenChannel | None:
        """The channel for a message; opened if it is missing or its schema has changed. None if that is too much."""
        known = self._channels.get(source)
        if known is not None and known.shown == kind:
            self._channels.move_to_end(source)
            return known
        if not self._limiter.allow(sender):
            return None
        return self._opened(source, kind)

    def _opened(self, source: ChannelSource, kind: PayloadType) -> OpenChannel:
        """A new channel for messages; it replaces the one that there is."""
        known = self._channels.get(source)
        if known is not None:
            self._close(known)
        elif len(self._channels) >= SHOWN_LIMITS.channels:
            self._close(next(iter(self._channels.values())))
        name = source.topic
        if name in self._names:
            name = f"{source.topic} ({source.schema or source.encoding})"
        schema = Schema(name=kind.schema_name, encoding=kind.schema_encoding, data=kind.schema_data)
        # The public class keeps each channel in a global dict for ever.
        channel = self._context._create_channel(name, message_encoding=kind.encoding, schema=schema)
        opened = OpenChannel(name, source, channel, kind)
        self._names.add(name)
        self._channels[source] = self._by_id[opened.channel.id()] = opened
        return opened

    def _close(self, opened: OpenChannel) -> None:
        opened.channel.close()
        self._names.discard(opened.name)
        del self._channels[opened.source], self._by_id[opened.channel.id()]

    def forget(self) -> None:
        """Repeat none of the messages so far to those who subscribe later."""
        for opened in self._channels.values():
            opened.last.clear()
            opened.size = 0

    def repeat_last(self, channel: int, client: int) -> None:
        """Send the last messages of a channel to a client that has subscribed to it."""
        opened = self._by_id.get(channel)
        if opened is None or not opened.last:
            return
        shown = [(self._types.shown(opened.source.topic, payload, kind), at) for payload, kind, at in opened.last]
        current = self._channel_for(opened.source, shown[-1][0][1], "")  # a schema that fits them all
        if current is opened:
            for (payload, kind), at in shown:
                if kind.schema_name == opened.shown.schema_name:
                    # A client's number is that of its sink, as long as nothing else in this process is one.
                    opened.channel.log(payload, log_time=at, sink_id=client)
        elif current is not None:  # with another schema: the client subscribes to the new one
            current.last, current.size = opened.last, opened.size


class _Listener(ServerListener):
    """What the SDK calls, on threads of its own."""

    def __init__(self, subscribed: Callable[[int, int], None], control: PlaybackControl | None) -> None:
        self._subscribed = subscribed
        self._control = control

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._subscribed(channel.id, client.id)

    def on_playback_control_request(self, playback_control_request: PlaybackControlRequest) -> PlaybackState | None:
        return None if self._control is None else self._control.answer(playback_control_request)

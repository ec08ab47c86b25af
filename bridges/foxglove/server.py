"""A server of the Foxglove SDK, with a channel for each topic and type."""

from __future__ import annotations

import asyncio
import logging
import random
import time
from collections import OrderedDict, deque
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from foxglove import Context, Schema, start_server
from foxglove.websocket import Capability, ServerListener

from bridges.foxglove.shown import ShownTypes
from mesh.background import call_in_loop
from mesh.flood import Rate, RateLimiter
from mesh.recording import encode_described
from mesh.role import Lifecycle
from schemas.payloads import EMPTY

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from contextlib import AsyncExitStack

    from foxglove.websocket import ChannelView, Client, PlaybackControlRequest, PlaybackState

    from bridges.foxglove.front import FoxgloveFront
    from bridges.foxglove.shown import Shown
    from mesh.flood import Drops
    from schemas.payloads import PayloadType

BACKLOG: Final = 256
"""Messages that wait for a client; beyond, the SDK drops the oldest."""
LARGEST: Final = 4 << 20
"""Bytes of the largest message that is shown."""
CHANNELS: Final = 512
"""Channels at a time; beyond, the one that was not used for longest is closed."""
NEW_CHANNELS: Final = Rate(per_second=4.0, burst=128)
"""New channels of one sender: clients learn of each."""
NEW_CHANNELS_IN_TOTAL: Final = Rate(per_second=16.0, burst=CHANNELS)
LONGEST_TOPIC: Final = 256
KEPT: Final = 50
"""The last messages of a channel, which are repeated to those who subscribe later."""
KEPT_BYTES: Final = 1 << 16
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
        """Remember a message."""
        self.last.append((payload, kind, at_ns))
        self.size += len(payload)
        while len(self.last) > KEPT or self.size > KEPT_BYTES:
            self.size -= len(self.last.popleft()[0])

    def forget(self) -> None:
        """Remember nothing."""
        self.last.clear()
        self.size = 0


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
    """`async with FoxgloveServer(front, name, drops) as server`, then `server.publish`. Used in one event loop.

    `known` are types of which only the name travels with a message. With `control` clients control a playback.
    """

    title = "Foxglove server"

    def __init__(
        self,
        front: FoxgloveFront,
        name: str,
        drops: Drops,
        *,
        known: tuple[PayloadType, ...] = (),
        control: PlaybackControl | None = None,
    ) -> None:
        self.front = front
        self._name = name
        self._drops = drops
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
        self._server = start_server(
            name=self._name,
            host=host,
            port=0,
            context=self._context,
            server_listener=_Listener(partial(call_in_loop, loop, self.repeat_last), control),
            capabilities=[] if control is None else [Capability.PlaybackControl, Capability.Time],
            playback_time_range=None if control is None else (control.start_ns, control.end_ns),
            message_backlog_size=BACKLOG,
        )
        stack.push_async_callback(self._end)
        self.front.inner = host, self._server.port

    async def _end(self) -> None:
        self.front.inner = None
        await asyncio.to_thread(self._server.stop)
        await self.front.disconnect()

    def publish(
        self, topic: str, payload: bytes, kind: PayloadType, *, at_ns: int | None = None, sender: str = ""
    ) -> None:
        """Show a message on a topic, received at that Unix time (ns; None: now).

        Messages of several types on one topic appear as several topics. What is too large or on too many topics is
        dropped, and counted by `sender`.
        """
        if len(payload) > LARGEST:
            self._drops.count("foxglove-too-large", sender)
            return
        source = ChannelSource(topic[:LONGEST_TOPIC], kind.encoding, kind.schema_name)
        known = self._channels.get(source)
        at = time.time_ns() if at_ns is None else at_ns
        if known is None or known.channel.has_sinks():
            shown = self._types.shown(source.topic, payload, kind)
            known = self._channel_for(source, shown, sender)
            if known is None:
                self._drops.count("foxglove-topics", sender)
                return
            known.channel.log(shown.payload, log_time=at)
        known.keep(payload, kind, at)

    def announce(self, topics: Iterable[tuple[str, PayloadType]]) -> None:
        """Let clients know of topics before there are messages, if their types have a schema: `CHANNELS` at most."""
        for topic, kind in islice(topics, CHANNELS):
            if kind.schema_data or kind == EMPTY:
                source = ChannelSource(topic[:LONGEST_TOPIC], kind.encoding, kind.schema_name)
                self._opened(source, kind)

    def publish_value(self, topic: str, value: Any, *, at_ns: int | None = None, sender: str = "") -> None:
        """Show data as JSON, or a message of `mesh.foxglove`."""
        payload, kind = encode_described(value)
        self.publish(topic, payload, kind, at_ns=at_ns, sender=sender)

    def broadcast_time(self, at_ns: int) -> None:
        """Tell all clients the time of the playback."""
        self._server.broadcast_time(at_ns)

    def broadcast_state(self, state: PlaybackState) -> None:
        """Tell all clients the state of the playback."""
        self._server.broadcast_playback_state(state)

    def _channel_for(self, source: ChannelSource, shown: Shown, sender: str) -> OpenChannel | None:
        """The channel for a message; opened if it is missing or its schema has changed. None if that is too much."""
        known = self._channels.get(source)
        if known is not None and known.shown == shown.type:
            self._channels.move_to_end(source)
            return known
        if not self._limiter.allow(sender):
            return None
        return self._opened(source, shown.type)

    def _opened(self, source: ChannelSource, kind: PayloadType) -> OpenChannel:
        """A new channel for messages; it replaces the one that there is."""
        known = self._channels.get(source)
        if known is not None:
            self._close(known)
        elif len(self._channels) >= CHANNELS:
            self._close(next(iter(self._channels.values())))
        name = source.topic
        if name in self._names:
            name = f"{source.topic} ({source.schema or source.encoding})"
        opened = OpenChannel(name, source, self._declare(name, kind), kind)
        self._names.add(name)
        self._channels[source] = self._by_id[opened.channel.id()] = opened
        return opened

    def _declare(self, name: str, kind: PayloadType) -> Any:
        schema = Schema(name=kind.schema_name, encoding=kind.schema_encoding, data=kind.schema_data)
        # The public class keeps each channel in a global dict for ever.
        return self._context._create_channel(name, message_encoding=kind.encoding, schema=schema)

    def _close(self, opened: OpenChannel) -> None:
        opened.channel.close()
        self._names.discard(opened.name)
        del self._channels[opened.source], self._by_id[opened.channel.id()]

    def forget(self) -> None:
        """Repeat none of the messages so far to those who subscribe later."""
        for opened in self._channels.values():
            opened.forget()

    def repeat_last(self, channel: int, client: int) -> None:
        """Send the last messages of a channel to a client that has subscribed to it."""
        opened = self._by_id.get(channel)
        if opened is None or not opened.last:
            return
        shown = [(self._types.shown(opened.source.topic, payload, kind), at) for payload, kind, at in opened.last]
        current = self._channel_for(opened.source, shown[-1][0], "")  # a schema that fits them all
        if current is opened:
            for one, at in shown:
                if one.type.schema_name == opened.shown.schema_name:
                    # A client's number is that of its sink, as long as nothing else in this process is one.
                    opened.channel.log(one.payload, log_time=at, sink_id=client)
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

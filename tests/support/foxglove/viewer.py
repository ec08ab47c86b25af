"""A client of Foxglove's protocol, as the application is one: by WebSocket and subprotocol, with other programs'
decoders."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
from collections.abc import Callable  # noqa: TC003 - a dataclass reads it
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import websockets
from mcap.records import Schema
from mcap_ros1.decoder import DecoderFactory as Ros1Decoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

from tests.support.recordings import JsonDecoders
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE, TIME, PLAYBACK = 1, 2, 5
PLAY, PAUSE = 0, 1
STATUS = {0: "playing", 1: "paused", 2: "buffering", 3: "ended"}


class Seen(NamedTuple):
    """A message that the viewer decoded."""

    topic: str
    value: Any
    log_time: int


class Playback(NamedTuple):
    """The state of a playback."""

    status: str
    at_ns: int
    speed: float
    did_seek: bool
    request: str


@dataclass
class Viewer:
    """What a connected application knows."""

    socket: Any
    wanted: Callable[[str], bool]
    info: dict[str, Any] = field(default_factory=dict)
    channels: dict[int, dict[str, Any]] = field(default_factory=dict)
    seen: list[Seen] = field(default_factory=list)
    states: list[Playback] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    _decoders: dict[int, Callable[[bytes], Any]] = field(default_factory=dict)

    @property
    def topics(self) -> dict[str, dict[str, Any]]:
        """The channels by topic."""
        return {channel["topic"]: channel for channel in self.channels.values()}

    def values(self, topic: str) -> list[Any]:
        """What was seen on a topic."""
        return [seen.value for seen in self.seen if seen.topic == topic]

    async def until_seen(self, topic: str, count: int = 1) -> list[Any]:
        """The values on a topic when there are so many."""
        await until(lambda: len(self.values(topic)) >= count, what=f"{count} messages on {topic}")
        return self.values(topic)

    async def control(self, command: int, *, speed: float = 1.0, seek: int | None = None, request: str) -> Playback:
        """Request a change of the playback; the state that answers."""
        text = request.encode()
        at = 0 if seek is None else seek
        head = struct.pack("<BBfBQI", 3, command, speed, seek is not None, at, len(text))
        await self.socket.send(head + text)
        await until(lambda: any(state.request == request for state in self.states), what=f"the answer to {request}")
        return next(state for state in self.states if state.request == request)

    async def read(self) -> None:
        """Take what comes, until the connection ends."""
        with suppress(websockets.ConnectionClosed):
            await self._read()

    async def _read(self) -> None:
        async for frame in self.socket:
            if isinstance(frame, str):
                await self._text(json.loads(frame))
            elif frame[0] == MESSAGE:
                subscription, log_time = struct.unpack_from("<IQ", frame, 1)
                channel = self.channels.get(subscription)
                if channel is not None:
                    value = self._decoder(channel)(frame[13:])
                    self.seen.append(Seen(channel["topic"], value, log_time))
            elif frame[0] == TIME:
                self.times.append(struct.unpack_from("<Q", frame, 1)[0])
            elif frame[0] == PLAYBACK:
                status, at, speed, did_seek, _ = struct.unpack_from("<BQfBI", frame, 1)
                self.states.append(Playback(STATUS[status], at, speed, bool(did_seek), frame[19:].decode()))

    async def _text(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "serverInfo":
                self.info = message
            case "advertise":
                for channel in message["channels"]:
                    self.channels[channel["id"]] = channel
                await self.subscribe(*[one["id"] for one in message["channels"] if self.wanted(one["topic"])])
            case "unadvertise":
                for channel in message["channelIds"]:
                    self.channels.pop(channel)
            case "status":
                self.statuses.append(message)

    async def subscribe(self, *channels: int) -> None:
        """Subscribe to channels; a subscription has the number of its channel."""
        subscriptions = [{"id": channel, "channelId": channel} for channel in channels]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def _decoder(self, channel: dict[str, Any]) -> Callable[[bytes], Any]:
        if (known := self._decoders.get(channel["id"])) is not None:
            return known
        text = channel["schema"]
        encoding = channel.get("schemaEncoding", "")
        data = base64.b64decode(text) if encoding == "protobuf" else text.encode()
        schema = Schema(channel["id"], data, encoding, channel["schemaName"])
        for factory in (JsonDecoders(), Ros1Decoders(), Ros2Decoders()):
            if (decoder := factory.decoder_for(channel["encoding"], schema)) is not None:
                return self._decoders.setdefault(channel["id"], decoder)
        raise AssertionError(f"no decoder for {channel}")


@asynccontextmanager
async def viewing(
    url: str, *topics: str, subprotocol: str = SUBPROTOCOL, wanted: Callable[[str], bool] | None = None, **options: Any
) -> AsyncIterator[Viewer]:
    """A viewer of these topics, or of those that are `wanted`, or of all."""
    choice = wanted or (lambda topic: not topics or topic in topics)
    given: Any = {"subprotocols": [subprotocol], "max_size": None, "close_timeout": 0.5} | options
    async with websockets.connect(url, **given) as socket:
        viewer = Viewer(socket, choice)
        reading = asyncio.create_task(viewer.read())
        try:
            await until(lambda: viewer.info or reading.done(), what="the server's greeting")
            yield viewer
        finally:
            reading.cancel()
        if reading.done() and not reading.cancelled() and (error := reading.exception()) is not None:
            raise error

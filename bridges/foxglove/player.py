"""Playing a recording under the control of Foxglove: play, pause, speed, seek. All clients see the same playback."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from contextlib import aclosing
from typing import TYPE_CHECKING, Final

from foxglove.websocket import PlaybackCommand, PlaybackState, PlaybackStatus

from bridges.foxglove.moments import Moments
from bridges.foxglove.server import PlaybackControl
from mesh.background import call_in_loop
from mesh.recording.playback import read_ahead

if TYPE_CHECKING:
    from collections.abc import Callable

    from foxglove.websocket import PlaybackControlRequest

    from bridges.foxglove.server import FoxgloveServer
    from mesh.recording import Objective, Played
    from schemas.payloads import PayloadType

SLOWEST: Final = 0.01
FASTEST: Final = 100.0
TICK: Final = 1 / 30
"""Seconds between two announcements of the playback's time."""
UNPAUSED: Final = 64
"""Messages that are due after which the event loop gets its turn."""


class PlaybackHead:
    """Where the playback is, in the recording's time (ns). For any thread; `clock` is monotonic, in ns."""

    def __init__(self, start_ns: int, end_ns: int, *, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.start_ns: Final = start_ns
        self.end_ns: Final = end_ns
        self._clock = clock
        self._lock = threading.Lock()
        self._at = start_ns
        self._since = clock()
        self._jump = start_ns
        self.speed = 1.0
        self.status = PlaybackStatus.Paused
        self.seeks = 0
        """How often the position jumped."""

    @property
    def now_ns(self) -> int:
        """The time in the recording."""
        with self._lock:
            return self._now()

    def handle(self, request: PlaybackControlRequest) -> PlaybackState:
        """Do what a client requests; the state afterwards."""
        with self._lock:
            plays = request.playback_command == PlaybackCommand.Play
            to = request.seek_time
            if to is None and plays and self.status == PlaybackStatus.Ended:
                to = self.start_ns
            self._at, self._since = self._now(), self._clock()
            if to is not None:
                self._at = min(max(to, self.start_ns), self.end_ns)
                self._jump = self._at
                self.seeks += 1
            speed = request.playback_speed
            self.speed = 1.0 if math.isnan(speed) else min(max(speed, SLOWEST), FASTEST)
            if to is not None or self.status != PlaybackStatus.Ended:
                self.status = PlaybackStatus.Playing if plays else PlaybackStatus.Paused
            return self._state(did_seek=to is not None, request=request.request_id)

    def jump(self) -> tuple[int, int]:
        """How often the position jumped, and where to."""
        with self._lock:
            return self.seeks, self._jump

    def go_on(self, seeks: int, at_ns: int) -> None:
        """Reading up to there took time that does not count, unless the position has jumped again."""
        with self._lock:
            if seeks == self.seeks:
                self._at, self._since = at_ns, self._clock()

    def end(self, seeks: int) -> PlaybackState | None:
        """All messages are played, after so many jumps; None if there was another one."""
        with self._lock:
            if seeks != self.seeks or self.status != PlaybackStatus.Playing:
                return None
            self._at, self.status = self.end_ns, PlaybackStatus.Ended
            return self._state(did_seek=False, request=None)

    def _now(self) -> int:
        if self.status != PlaybackStatus.Playing:
            return self._at
        return min(self.end_ns, self._at + int((self._clock() - self._since) * self.speed))

    def _state(self, *, did_seek: bool, request: str | None) -> PlaybackState:
        return PlaybackState(self.status, self._at, self.speed, did_seek, request)


class RecordingPlayer:
    """Plays a recording as clients control it: `FoxgloveServer(…, control=player.control)`, then `run(server)`."""

    def __init__(self, recording: Objective) -> None:
        self._recording = recording
        self.head = PlaybackHead(recording.start_ns, recording.start_ns + recording.duration_ns)
        self._moments = Moments(recording)
        self._types = _widest(recording)
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()

    @property
    def control(self) -> PlaybackControl:
        """What the server needs to know of the playback."""
        return PlaybackControl(self.head.start_ns, self.head.end_ns, self._answer)

    def _answer(self, request: PlaybackControlRequest) -> PlaybackState:
        """Called on a thread of the SDK."""
        state = self.head.handle(request)
        call_in_loop(self._loop, self._changed.set)
        return state

    async def run(self, server: FoxgloveServer) -> None:
        """Play until cancelled. Raises `CorruptRecording` if the file has changed."""
        server.announce((topic, kind) for (topic, _, _), kind in self._types.items())
        while True:
            seeks, at_ns = self.head.jump()
            index = await self._show_moment(server, at_ns) if seeks else 0
            self.head.go_on(seeks, at_ns)
            await self._play(server, index, seeks)

    async def _show_moment(self, server: FoxgloveServer, at_ns: int) -> int:
        """Show the last message of each topic up to a time; returns the number of the first message after it."""
        moment = await asyncio.to_thread(self._moments.at, at_ns)
        server.forget()
        for message in moment.last:
            self._show(server, message)
        server.broadcast_time(at_ns)
        return moment.number

    async def _play(self, server: FoxgloveServer, index: int, seeks: int) -> None:
        """Show the messages from a number on, each when it is due, until the position jumps."""
        head, late = self.head, 0
        async with aclosing(read_ahead(self._recording.messages(from_index=index))) as messages:
            async for message in messages:
                while head.now_ns < message.log_time_ns or head.status != PlaybackStatus.Playing:
                    late = 0
                    await self._wait(server, message.log_time_ns)
                    if head.seeks != seeks:
                        return
                self._show(server, message)
                late += 1
                if late % UNPAUSED == 0:
                    await asyncio.sleep(0)
                    if head.seeks != seeks:
                        return
        while head.seeks == seeks:
            self._changed.clear()
            if (state := head.end(seeks)) is not None:
                await asyncio.sleep(TICK)  # the answer to a client goes first
                if head.seeks != seeks:
                    return
                server.broadcast_state(state)
            await self._changed.wait()

    async def _wait(self, server: FoxgloveServer, due_ns: int) -> None:
        """Wait until a time of the recording, for the next tick, or until a client changes something."""
        self._changed.clear()
        left = TICK
        if self.head.status == PlaybackStatus.Playing:
            server.broadcast_time(self.head.now_ns)
            left = min(TICK, (due_ns - self.head.now_ns) / 1e9 / self.head.speed)
        try:
            async with asyncio.timeout(None if self.head.status != PlaybackStatus.Playing else max(left, 0)):
                await self._changed.wait()
        except TimeoutError:
            return

    def _show(self, server: FoxgloveServer, message: Played) -> None:
        kind = self._types.get((message.topic, message.type.encoding, message.type.schema_name), message.type)
        server.publish(message.topic, message.payload, kind, at_ns=message.log_time_ns)


def _widest(recording: Objective) -> dict[tuple[str, str, str], PayloadType]:
    """The last type of each topic by encoding and name: a recorder widens the schemas of JSON."""
    return {(topic.name, topic.type.encoding, topic.type.schema_name): topic.type for topic in recording.topics}

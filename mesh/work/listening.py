"""What is published on a topic of a job, for its handlers."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Self

from mesh.background import call_in_loop
from schemas.errors import InvalidPayload
from schemas.payloads import decode_value

if TYPE_CHECKING:
    from schemas.payloads import PayloadType

WAITING: Final = 1024
"""Messages that wait for the handler; beyond, the oldest are left out."""
WAITING_BYTES: Final = 8 << 20
"""Bytes of their payloads, in the same way."""


class JobMessages:
    """The messages on a topic of a job since `Job.listen`, decoded, in order; iteration ends with the job.

    If too many wait, the oldest are left out, and counted in `dropped`. For one consumer.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.dropped = 0
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[bytes, PayloadType]] = deque()
        self._bytes = 0
        self._ended = False
        self._changed = asyncio.Event()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        while True:
            while self._waiting:
                payload, kind = self._take()
                try:
                    return decode_value(payload, kind)
                except InvalidPayload:
                    continue  # the recording has it; a handler can't use it
            if self._ended:
                raise StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()

    def deliver(self, payload: bytes, kind: PayloadType) -> None:
        """Add a message. For any thread."""
        call_in_loop(self._loop, self._add, payload, kind)

    def end(self) -> None:
        """End the iteration after what waits. For any thread."""
        call_in_loop(self._loop, self._end)

    def _add(self, payload: bytes, kind: PayloadType) -> None:
        self._waiting.append((payload, kind))
        self._bytes += len(payload)
        while len(self._waiting) > WAITING or (self._bytes > WAITING_BYTES and len(self._waiting) > 1):
            self._take()
            self.dropped += 1
        self._changed.set()

    def _take(self) -> tuple[bytes, PayloadType]:
        payload, kind = self._waiting.popleft()
        self._bytes -= len(payload)
        return payload, kind

    def _end(self) -> None:
        self._ended = True
        self._changed.set()

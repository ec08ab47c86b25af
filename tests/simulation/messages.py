"""What a simulated Zenoh session gives to its callers: samples, replies, channels, cancellation."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import zenoh

from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.simulation.scheduler import Fiber


@lru_cache(65_536)
def expression(text: str) -> zenoh.KeyExpr:
    return zenoh.KeyExpr(text)


@lru_cache(262_144)
def matches(selector: str, key: str) -> bool:
    """Whether two key expressions have a key in common."""
    return bool(expression(selector).intersects(expression(key)))


class Payload:
    """`zenoh.ZBytes`."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def to_bytes(self) -> bytes:
        """The bytes."""
        return self._data

    def __len__(self) -> int:
        return len(self._data)


class Sample:
    """`zenoh.Sample`."""

    def __init__(self, key: str, payload: bytes, encoding: str = "", kind: Any = None) -> None:
        self.key_expr = expression(key)
        self.payload = Payload(payload)
        self.encoding = encoding
        self.kind = zenoh.SampleKind.PUT if kind is None else kind
        self.timestamp = None
        self.attachment = None


@dataclass
class Reply:
    """`zenoh.Reply`."""

    ok: Sample | None
    err: Any
    replier_id: Any


class CancellationToken:
    """`zenoh.CancellationToken`."""

    def __init__(self) -> None:
        self.is_cancelled = False
        self._queries: list[Callable[[], None]] = []

    def cancel(self) -> None:
        """End the queries of this token."""
        self.is_cancelled = True
        for end in self._queries:
            end()
        self._queries.clear()

    def add(self, end: Callable[[], None]) -> None:
        """Call `end` when it is cancelled."""
        self._queries.append(end)


class FifoChannel:
    """`zenoh.handlers.FifoChannel`: what to make; the queue itself is a `Mailbox`."""

    drops_oldest = False

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity


class RingChannel(FifoChannel):
    """`zenoh.handlers.RingChannel`."""

    drops_oldest = True


class Callback:
    """`zenoh.handlers.Callback`; here it is always called in the same thread, `indirect` or not."""

    def __init__(
        self, callback: Callable[[Any], object], drop: Callable[[], object] | None = None, *, indirect: bool = True
    ) -> None:
        self.callback = callback
        self.drop = drop

    def __call__(self, received: Any) -> object:
        return self.callback(received)


class Mailbox:
    """A queue between the session and a thread of the process."""

    def __init__(self, spec: FifoChannel) -> None:
        self._items: deque[Any] = deque()
        self._spec = spec
        self._closed = False
        self._waiting: deque[Fiber] = deque()

    def put(self, item: Any) -> None:
        """Add an item."""
        if self._closed:
            return
        if len(self._items) >= self._spec.capacity and self._spec.drops_oldest:
            self._items.popleft()
        self._items.append(item)
        if self._waiting:
            scheduler().wake(self._waiting.popleft())

    def close(self) -> None:
        """No more items will come."""
        self._closed = True
        while self._waiting:
            scheduler().wake(self._waiting.popleft())

    def try_recv(self) -> Any:
        """The next item, None if there is none now."""
        if self._items:
            return self._items.popleft()
        if self._closed:
            raise zenoh.ZError("the channel is closed")
        return None

    def recv(self) -> Any:
        """The next item; waits for it. Raises `ZError` when the channel is closed."""
        while True:
            if (item := self.try_recv()) is not None:
                return item
            current = scheduler().current
            assert current is not None
            self._waiting.append(current)
            scheduler().wait()

    def __iter__(self) -> Iterator[Any]:
        while True:
            try:
                yield self.recv()
            except zenoh.ZError:
                return

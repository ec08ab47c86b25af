"""The interface of a protocol on a serial line, and the protocols that are installed.

A dialect is the host's side of a protocol, without a port and without a clock: `SerialLine` feeds it bytes and the
time, sends what `outgoing` returns, and delivers its `events`. Times are seconds of any monotonic clock.

A package adds a dialect by an entry point of the group `aira.dialects`: the name is what users type after `--protocol`,
the value names a subclass of `Dialect`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final

from bridges.serial.errors import BoardBusy, BrokenDialect, UnknownDialect
from mesh.plugins import entry_points

if TYPE_CHECKING:
    from collections.abc import Mapping

    from schemas.payloads import PayloadType

ENTRY_POINTS: Final = "aira.dialects"
QUEUE_SIZE: Final = 256
"""The most commands that wait for a board; further ones are rejected."""


class Flow(Enum):
    """The direction of a topic, as the board sees it."""

    PUBLISHES = "says"
    """The board publishes messages on it."""
    SUBSCRIBES = "hears"
    """The board takes commands on it."""
    SERVES = "serves"
    """The board answers requests on it: a service."""
    REQUESTS = "asks"
    """The board sends requests, which the mesh answers."""


@dataclass(frozen=True)
class BoardTopic:
    """A topic that the board has announced: its name with the leading `/` of ROS, and the type of its messages."""

    name: str
    flow: Flow
    type: PayloadType
    id: int


@dataclass(frozen=True)
class DeviceInfo:
    """What a board reports about itself; a rosserial board reports only its topics."""

    name: str
    version: str
    topics: tuple[BoardTopic, ...]

    def find(self, name: str, *flows: Flow) -> BoardTopic | None:
        """The topic of that name with one of these directions."""
        return next((topic for topic in self.topics if topic.name == name and topic.flow in flows), None)


@dataclass(eq=False)
class Command:
    """A message for the board, as a payload of its topic's type. It is not sent after `deadline`."""

    topic: str
    payload: bytes
    deadline: float = float("inf")
    begun: bool = field(default=False, init=False)
    """Whether any of it may have reached the board."""


class CallStatus(Enum):
    """What is known about a command at its end."""

    DONE = "done"
    """The board confirmed that it did it, once."""
    READ = "read"
    """The board read on after it. It confirms no more: a message damaged on the line is skipped silently."""
    FAILED = "failed"
    """It was not done, or this is not known; see the reason."""


@dataclass(frozen=True)
class BoardReady:
    """A board answers and has reported what it is."""

    info: DeviceInfo


@dataclass(frozen=True)
class BoardLost:
    """The board that was ready was unplugged, restarted, or stopped answering."""

    reason: str


@dataclass(frozen=True)
class MessageReceived:
    """The board published a message, or (`Flow.REQUESTS`) sent a request; `Dialect.respond` answers it."""

    topic: BoardTopic
    payload: bytes


@dataclass(frozen=True)
class CommandFinished:
    """A command has ended. `payload`, of type `type`, is the board's answer; a failed command has a `reason` (a key of
    `errors.CALL_ERRORS`) and a sentence, `detail`."""

    command: Command
    status: CallStatus
    payload: bytes = b""
    type: PayloadType | None = None
    reason: str = ""
    detail: str = ""


@dataclass(frozen=True)
class BoardLogged:
    """The board wrote to its log; `level` is one of Python's logging levels."""

    level: int
    text: str


LineEvent = BoardReady | BoardLost | MessageReceived | CommandFinished | BoardLogged


@dataclass
class LineCounters:
    """Frames and bytes on a line since it was created."""

    received: int = 0
    """Whole frames from the board."""
    damaged: int = 0
    """Frames of the board with a wrong checksum."""
    refused: int = 0
    """Whole frames of the board that can't be decoded."""
    noise: int = 0
    """Bytes that belong to no frame."""
    missed: int = 0
    """Messages of the board that are missing in its sequence numbers (own frames only)."""
    sent: int = 0
    """Frames to the board, repetitions included."""
    repeated: int = 0
    """Frames sent again because no answer came."""
    stray: int = 0
    """Frames of the board that answer no pending request, or are on a topic that it has not announced."""


class Dialect(ABC):
    """The host's side of a protocol. Nothing blocks; all methods are called on one thread."""

    info: DeviceInfo | None = None
    """What the board has reported about itself; None while it is not ready."""
    protocol: str = ""
    """The name under which the dialect is installed."""
    silence: float = 5.0
    """Seconds on an open port without an answer of a board, after which a warning is logged."""

    def __init__(self, *, baud: int, parameters: Mapping[str, object] | None = None) -> None:
        """`baud` is the speed of the line in bits per second, `parameters` are values that firmware may request."""
        self.baud = baud
        """The speed that the line has to have now, in bits per second."""
        self.attempt = f"at {baud} baud: do --baud and --protocol match the firmware?"
        """What to report if no board answers: how it was asked."""
        self.counters = LineCounters()
        self._parameters = dict(parameters or {})
        self._queue: list[Command] = []
        self._events: list[LineEvent] = []
        self._out = bytearray()
        self._is_open = False

    @property
    @abstractmethod
    def next_tick(self) -> float:
        """When `tick` has to be called at the latest; infinity for never."""

    @abstractmethod
    def opened(self, now: float) -> None:
        """The line was opened."""

    @abstractmethod
    def closed(self, now: float) -> None:
        """The line was closed, by us or by a pulled cable. Queued commands stay queued."""

    @abstractmethod
    def receive(self, data: bytes, now: float) -> None:
        """These bytes have arrived."""

    @abstractmethod
    def tick(self, now: float) -> None:
        """The time is `now`: give up what is late, repeat what was not answered."""

    @abstractmethod
    def submit(self, command: Command, now: float) -> None:
        """Queue a command; `CommandFinished` reports its end. Raises `InvalidBoardMessage`, `BoardBusy`."""

    def respond(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Answer a request of the board (`Flow.REQUESTS`), if the boards of this dialect send any."""
        raise NotImplementedError(f"boards of this dialect send no requests: {topic.name}")

    def outgoing(self) -> bytes:
        """The bytes to send now; each is returned once."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def events(self) -> list[LineEvent]:
        """The events since the last call, in order."""
        events, self._events = self._events, []
        return events

    @property
    def _next_expiry(self) -> float:
        """When the first queued command expires."""
        return min((command.deadline for command in self._queue), default=float("inf"))

    def _enqueue(self, command: Command) -> None:
        """Append a command. Raises `BoardBusy` if the queue is full."""
        if len(self._queue) >= QUEUE_SIZE:
            raise BoardBusy(command.topic, QUEUE_SIZE)
        self._queue.append(command)

    def _expire_queued(self, now: float) -> None:
        """Fail the commands that have waited too long."""
        late = [command for command in self._queue if command.deadline <= now]
        self._queue = [command for command in self._queue if command.deadline > now]
        for command in late:
            self._fail(command, "expired", "the board was absent, or busy with earlier commands")

    def _fail(self, command: Command, reason: str, detail: str) -> None:
        self._events.append(CommandFinished(command, CallStatus.FAILED, reason=reason, detail=detail))


def dialect_names() -> list[str]:
    """The names of the installed dialects."""
    return sorted(entry_points(ENTRY_POINTS))


def load_dialect(name: str) -> type[Dialect]:
    """The installed dialect of that name, imported now. Raises `UnknownDialect`, `BrokenDialect`."""
    installed = entry_points(ENTRY_POINTS)
    if name not in installed:
        raise UnknownDialect(name, sorted(installed))
    try:
        dialect: type[Dialect] = installed[name].load()
    except (ImportError, AttributeError) as error:
        raise BrokenDialect(name, installed[name].package, error) from error
    return dialect

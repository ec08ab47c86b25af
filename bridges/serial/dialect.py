"""What both links have in common: a dialect is the host's side of a protocol, without a port and without a clock.

A dialect is told what arrives and what time it is, and says what to send and what has happened. Times are seconds of
any clock that only goes forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

from bridges.serial.errors import BoardBusy

if TYPE_CHECKING:
    from schemas.payloads import PayloadType

QUEUED: Final = 256
"""Commands that wait for a board at most; more are refused."""


class Flow(Enum):
    """Which way a topic goes, as the board sees it."""

    SAYS = "says"
    """The board publishes it."""
    HEARS = "hears"
    """The board takes commands on it."""
    SERVES = "serves"
    """The board answers requests on it."""
    ASKS = "asks"
    """The board asks, and somebody in the mesh answers."""


@dataclass(frozen=True)
class BoardTopic:
    """A topic that the board has announced: `name` as in ROS with its leading `/`, and the type of its messages."""

    name: str
    flow: Flow
    type: PayloadType
    id: int


@dataclass(frozen=True)
class About:
    """What a board says of itself; a rosserial one says only its topics."""

    name: str
    version: str
    topics: tuple[BoardTopic, ...]

    def find(self, name: str, *flows: Flow) -> BoardTopic | None:
        """The topic of that name which goes one of these ways."""
        return next((topic for topic in self.topics if topic.name == name and topic.flow in flows), None)


@dataclass(eq=False)
class Command:
    """A message for the board, as a payload of its topic's type. `deadline`: not to be begun after it."""

    topic: str
    payload: bytes
    deadline: float = float("inf")
    begun: bool = field(default=False, init=False)
    """Whether any of it may have reached the board."""


class Ending(Enum):
    """What is known of a command at its end."""

    DONE = "done"
    """The board says that it has done it; once."""
    READ = "read"
    """The board read on after it. It says no more than that: a message that was damaged is skipped silently."""
    FAILED = "failed"
    """It was not done, or nobody knows; see the reason."""


@dataclass(frozen=True)
class Ready:
    """The board is there and has said what it is."""

    about: About


@dataclass(frozen=True)
class Gone:
    """The board that was ready is there no more: it was unplugged, restarted, or fell silent."""

    why: str


@dataclass(frozen=True)
class Said:
    """The board published a message, or (`Flow.ASKS`) asks something, to be answered by `Dialect.answer`."""

    topic: BoardTopic
    payload: bytes


@dataclass(frozen=True)
class Ended:
    """A command has come to its end. `payload` is what the board answered; of the failed ones `reason` is a word of
    `errors.REASONS` and `detail` a sentence."""

    command: Command
    ending: Ending
    payload: bytes = b""
    type: PayloadType | None = None
    reason: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Logged:
    """The board wrote to its log; `level` is one of Python's logging levels."""

    level: int
    text: str


Happening = Ready | Gone | Said | Ended | Logged


@dataclass
class Counters:
    """What went over a line, and what did not."""

    received: int = 0
    """Whole frames from the board."""
    damaged: int = 0
    """Frames of the board whose check did not hold."""
    refused: int = 0
    """Whole frames of the board that can't be what they claim to be."""
    noise: int = 0
    """Bytes that belong to no frame."""
    missed: int = 0
    """Messages of the board that are missing in their counting (own frames only)."""
    sent: int = 0
    """Frames to the board, repetitions included."""
    repeated: int = 0
    """Frames sent once more, since nothing was heard of the first."""
    stray: int = 0
    """Answers of the board to what nobody asked (any more)."""


class Dialect(Protocol):
    """The host's side of a protocol. Nothing blocks, nothing waits; all methods are called on one thread."""

    counters: Counters

    @property
    def about(self) -> About | None:
        """What the board has said of itself; None while it is not ready."""

    @property
    def due(self) -> float:
        """When `pass_time` has to be called at the latest; infinity for never."""

    def opened(self, now: float) -> None:
        """The line is open."""

    def closed(self, now: float) -> None:
        """The line is closed, by us or by the cable; what waits for the board goes on waiting."""

    def receive(self, data: bytes, now: float) -> None:
        """These bytes have come."""

    def pass_time(self, now: float) -> None:
        """It is `now`."""

    def submit(self, command: Command, now: float) -> None:
        """Have the board do something, in its turn; the end is told by `Ended`. Raises `UnfitMessage`, `BoardBusy`."""

    def answer(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Answer what the board asked."""

    def outgoing(self) -> bytes:
        """What to send now, once."""

    def happenings(self) -> list[Happening]:
        """What has happened since the last call, in order."""


class Waiting:
    """The commands that wait for their turn."""

    def __init__(self) -> None:
        self._commands: list[Command] = []

    def add(self, command: Command) -> None:
        """Put it at the end. Raises `BoardBusy` if too many wait."""
        if len(self._commands) >= QUEUED:
            raise BoardBusy(command.topic, QUEUED)
        self._commands.append(command)

    def take(self) -> Command | None:
        """The next one, or None."""
        return self._commands.pop(0) if self._commands else None

    def expired(self, now: float) -> list[Command]:
        """Take out those whose deadline has passed."""
        late = [command for command in self._commands if command.deadline <= now]
        self._commands = [command for command in self._commands if command.deadline > now]
        return late

    @property
    def due(self) -> float:
        """When the first of them expires."""
        return min((command.deadline for command in self._commands), default=float("inf"))


class Host:
    """What the host's side of any protocol has: commands that wait for their turn, and what has happened."""

    def __init__(self) -> None:
        self.counters = Counters()
        self._waiting = Waiting()
        self._happened: list[Happening] = []

    def happenings(self) -> list[Happening]:
        """What has happened since the last call, in order."""
        happened, self._happened = self._happened, []
        return happened

    def _expire(self, now: float) -> None:
        """Give up the commands that have waited too long."""
        for command in self._waiting.expired(now):
            self._fail(command, "expired", "the board was not there, or busy with others before it")

    def _fail(self, command: Command, reason: str, detail: str) -> None:
        self._happened.append(Ended(command, Ending.FAILED, reason=reason, detail=detail))

"""The interface of a protocol on a serial line, the protocols that are installed, and how a board's is found.

A dialect is the host's side of a protocol, without a port and without a clock: `SerialLine` feeds it bytes and the
time, sends what `outgoing` returns, and delivers its `events`. Times are seconds of any monotonic clock.

A package adds a dialect by an entry point of the group `aira.dialects`: the name is what users type after `--protocol`,
the value names a subclass of `Dialect`. `DetectingDialect` is the one that a board is found to speak.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from mesh.base.extras import entry_points
from mesh.base.log_context import log_event
from mesh.errors import AiraError, ConfigurationError, InputError, RemoteError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from schemas.payloads import PayloadType


R = TypeVar("R")


class LineError(RemoteError, code="line-error"):
    """A serial port can't be opened, read or written; the code says why, if that is known."""


class CommandRefused(AiraError, code="invalid-board-message"):
    """A command was not taken: it has the wrong type, an unknown topic, or is too long; or too many wait for the board.

    `reason` is one of `REASONS`.
    """

    def __init__(self, topic: str, why: str, *, reason: str = "unfit", code: str = "") -> None:
        super().__init__(f"a message for {topic} can't be sent: {why}", code=code)
        self.topic = topic
        self.reason = reason


class CallFailed(AiraError, code="call-failed"):
    """A call to a device failed, for a `reason` (a word for programs), and its code says what that means.

    `call-refused`: the device or its edge agent would refuse it again (`refused`, `unfit`). `no-such-topic`: the device
    has no topic of that name to call. `call-not-done`: it certainly was not done, so it is safe to try again (`absent`,
    `expired`, `full`, `stopped`). `call-in-doubt`: the device was restarted or unplugged before it answered (`doubt`).
    """

    def __init__(self, topic: str, reason: str, detail: str, *, code: str = "") -> None:
        super().__init__(f"{topic}: {detail}" + (f" ({reason})" if reason != code else ""), code=code)
        self.topic = topic
        self.reason = reason


REASONS: Final = frozenset({"refused", "unfit", "absent", "expired", "full", "stopped", "doubt"})
"""The reasons for which a call fails, as they travel."""


def call_failed(topic: str, reason: str, detail: str) -> CallFailed:
    """The error for one of these reasons."""
    if reason in ("refused", "unfit"):
        return CallFailed(topic, reason, detail, code="call-refused")
    if reason in ("absent", "expired", "full", "stopped"):
        return CallFailed(topic, reason, detail, code="call-not-done")
    return CallFailed(topic, reason, detail, code="call-in-doubt")


ENTRY_POINTS: Final = "aira.dialects"


class CommandLimits(NamedTuple):
    """How commands wait for a board that is absent or busy."""

    patience: float = 30.0
    """Seconds that one waits, by default."""
    waiting: int = 256
    """The most that wait; further ones are rejected."""


COMMAND_LIMITS: Final = CommandLimits()


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
    """A topic that the board has announced: its name with the leading `/` of ROS, and the type of its messages.

    A board may have several publishers or subscribers of one topic: these are equal, and differ in `id` only.
    """

    name: str
    flow: Flow
    type: PayloadType
    id: int = field(compare=False)


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
    """A command has ended. `payload`, of type `type`, is the board's answer; a failed command has a `reason` (of
    `REASONS`) and a sentence, `detail`."""

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
        """Queue a command; `CommandFinished` reports its end. Raises `CommandRefused`."""

    def drop_queued(self, now: float) -> None:
        """Fail the commands that wait for the board, because it has to stop."""
        dropped, self._queue = self._queue, []
        for command in dropped:
            self._fail(command, "stopped", "the device was told to stop before it was sent")

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
        return min((command.deadline for command in self._queue), default=float("inf"))

    def _enqueue(self, command: Command) -> None:
        """Append a command. Raises `CommandRefused` if the queue is full."""
        if len(self._queue) >= COMMAND_LIMITS.waiting:
            why = f"{COMMAND_LIMITS.waiting} commands are already waiting for the board"
            raise CommandRefused(command.topic, why, reason="full", code="board-busy")
        self._queue.append(command)

    def _expire_queued(self, now: float) -> None:
        late = [command for command in self._queue if command.deadline <= now]
        self._queue = [command for command in self._queue if command.deadline > now]
        for command in late:
            self._fail(command, "expired", "the board was absent, or busy with earlier commands")

    def _next_of(self, resolve: Callable[[Command], R]) -> tuple[Command, R] | None:
        """The first queued command that `resolve` takes, and what it returns; those that it refuses fail."""
        while self._queue:
            command = self._queue.pop(0)
            try:
                resolved = resolve(command)
            except CommandRefused as error:
                self._fail(command, error.reason, str(error))
            else:
                command.begun = True
                return command, resolved
        return None

    def _fail(self, command: Command, reason: str, detail: str) -> None:
        self._events.append(CommandFinished(command, CallStatus.FAILED, reason=reason, detail=detail))


def dialect_names() -> list[str]:
    return sorted(entry_points(ENTRY_POINTS))


def load_dialect(name: str) -> type[Dialect]:
    """The installed dialect of that name, imported now. Raises `InputError`, `ConfigurationError` if it can't be."""
    installed = entry_points(ENTRY_POINTS)
    if name not in installed:
        raise InputError(
            f"there is no dialect {name!r}; installed: {', '.join(sorted(installed)) or 'none'}",
            hint="choose an installed one, or (re)install the package that provides it",
            code="unknown-dialect",
        )
    try:
        dialect: type[Dialect] = installed[name].load()
    except (ImportError, AttributeError) as error:
        package = installed[name].package
        raise ConfigurationError(
            f"can't load the dialect {name!r} of {package}: {type(error).__name__}: {error}",
            hint=f"reinstall or uninstall {package}",
            code="dialect-broken",
        ) from error
    return dialect


log = logging.getLogger(__name__)

AUTO: Final = "auto"
DETECTED: Final = ("frames", "rosserial")
"""The protocols that are tried; boards with other protocols may be disturbed by their questions."""
BAUDS: Final = (57_600, 115_200, 9_600, 38_400, 19_200, 230_400, 250_000, 500_000, 1_000_000)
"""The baud rates of boards, the usual ones first."""


class SearchPace(NamedTuple):
    """How long the protocol and the baud rate of a board are searched for, in seconds."""

    first: float = 3.0
    """At the first baud rate after the port was opened: opening it resets most boards, which takes almost two."""
    each: float = 0.8
    """At each further baud rate."""
    longest: float = 10.0
    """At a baud rate at which whole frames arrive, until the board has introduced itself."""
    again: float = 15.0
    """Without an answer in the protocol that was found, after which the search begins again."""


SEARCH_PACE: Final = SearchPace()


def make_dialect(protocol: str, baud: int, parameters: Mapping[str, object] | None = None) -> Dialect:
    """The dialect `protocol` at `baud` bits per second; with `auto`, or 0, that which a board is found to have.

    Raises as `load_dialect`.
    """
    if protocol == AUTO or not baud:
        protocols = DETECTED if protocol == AUTO else (protocol,)
        return DetectingDialect(protocols, (baud,) if baud else BAUDS, parameters=parameters)
    dialect = load_dialect(protocol)(baud=baud, parameters=parameters)
    dialect.protocol = protocol
    return dialect


class DetectingDialect(Dialect):
    """The one of several protocols that the board speaks, at one of several baud rates.

    While none is found, `baud` is the one that is being tried, `protocol` is empty, and commands wait.
    """

    def __init__(
        self,
        protocols: Sequence[str],
        bauds: Sequence[int],
        *,
        parameters: Mapping[str, object] | None = None,
        seconds_to_search_again: float = SEARCH_PACE.again,
    ) -> None:
        super().__init__(baud=bauds[0], parameters=parameters)
        self._kinds = {protocol: load_dialect(protocol) for protocol in protocols}
        self._bauds = tuple(bauds)
        self._search_again = seconds_to_search_again
        self._trials: dict[str, Dialect] = {}
        self._trial_began = self._trial_ends = float("inf")
        self._found: Dialect | None = None
        self._unfinished = 0
        self._absent_since = float("inf")
        self.silence = SEARCH_PACE.first + SEARCH_PACE.each * len(bauds)
        rates = ", ".join(map(str, self._bauds))
        self.attempt = f"in {' or '.join(protocols)}, at {rates} baud: is the firmware loaded, in another protocol?"

    @property
    def next_tick(self) -> float:
        if self._found is not None:
            again = self._absent_since + self._search_again if not self._unfinished else float("inf")
            return min(again, self._found.next_tick)
        return min(self._next_expiry, self._trial_ends, *(trial.next_tick for trial in self._trials.values()))

    def opened(self, now: float) -> None:
        self._is_open, self._absent_since = True, now
        if self._found is not None:
            self._found.opened(now)
            self._pass_on(now)
        else:
            self._try(self.baud, now, SEARCH_PACE.first)

    def closed(self, now: float) -> None:
        """The search ends; what was found is kept for the next time."""
        self._is_open, self._absent_since = False, float("inf")
        self._trials.clear()
        self._trial_ends = float("inf")
        self._out.clear()
        if self._found is not None:
            self._found.closed(now)
            self._pass_on(now)

    def receive(self, data: bytes, now: float) -> None:
        if self._found is not None:
            self._found.receive(data, now)
            self._pass_on(now)
            return
        for protocol, trial in self._trials.items():
            trial.receive(data, now)
            if trial.info is not None:
                self._use(protocol, trial, now)
                return

    def tick(self, now: float) -> None:
        """Repeat the questions, try the next baud rate, or begin to search again."""
        if self._found is not None:
            self._found.tick(now)
            self._pass_on(now)
            if not self._unfinished and self._absent_since + self._search_again <= now:
                self._found = None
                self._try(self.baud, now, SEARCH_PACE.each)
            return
        self._expire_queued(now)
        for protocol, trial in self._trials.items():
            trial.tick(now)
            if trial.info is not None:
                self._use(protocol, trial, now)
                return
        if self._trial_ends <= now:
            self._end_trial(now)

    def submit(self, command: Command, now: float) -> None:
        if self._found is None:
            self._enqueue(command)
            return
        self._found.submit(command, now)
        self._unfinished += 1
        self._pass_on(now)

    def drop_queued(self, now: float) -> None:
        super().drop_queued(now)
        if self._found is not None:
            self._found.drop_queued(now)
            self._pass_on(now)

    def respond(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        if self._found is not None:
            self._found.respond(topic, payload, now)
            self._pass_on(now)

    def outgoing(self) -> bytes:
        for dialect in self._trials.values() if self._found is None else (self._found,):
            self._out += dialect.outgoing()
        return super().outgoing()

    def _try(self, baud: int, now: float, seconds: float) -> None:
        self.baud, self.protocol = baud, ""
        self._trial_began, self._trial_ends = now, now + seconds
        self._trials = {name: kind(baud=baud, parameters=self._parameters) for name, kind in self._kinds.items()}
        for trial in self._trials.values():
            trial.opened(now)

    def _end_trial(self, now: float) -> None:
        """Try the next baud rate, unless whole frames arrive at this one."""
        is_heard = any(trial.counters.received for trial in self._trials.values())
        if is_heard and now < self._trial_began + SEARCH_PACE.longest:
            self._trial_ends = self._trial_began + SEARCH_PACE.longest
            return
        self._try(self._bauds[(self._bauds.index(self.baud) + 1) % len(self._bauds)], now, SEARCH_PACE.each)

    def _use(self, protocol: str, dialect: Dialect, now: float) -> None:
        """The board speaks this protocol: continue where its trial is."""
        self._found, self.protocol, self.counters = dialect, protocol, dialect.counters
        self._trials.clear()
        self._trial_ends = float("inf")
        found = log_event("board-detected", protocol=protocol, baud=self.baud)
        log.info("the board speaks %s at %d baud", protocol, self.baud, extra=found)
        waiting, self._queue = self._queue, []
        self._pass_on(now)
        for command in waiting:
            try:
                self.submit(command, now)
            except CommandRefused as error:
                self._fail(command, error.reason, str(error))

    def _pass_on(self, now: float) -> None:
        """Take over what the found dialect knows and reports."""
        assert self._found is not None
        events = self._found.events()
        self._unfinished -= sum(isinstance(event, CommandFinished) for event in events)
        self._events += events
        self.info = self._found.info
        if self.info is not None:
            self._absent_since = float("inf")
        elif self._is_open:
            self._absent_since = min(self._absent_since, now)

"""Which protocol a board speaks, and at which baud rate, found by trying.

At each baud rate all protocols ask the board at once: they skip what is not theirs, and so do boards. The first one in
which a board introduces itself is used from then on, also when the cable was pulled in between. Only if no board
answers in it for a while, and no command waits for its outcome, the search begins again.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from bridges.serial.dialect import CommandFinished, Dialect, load_dialect
from bridges.serial.errors import BoardBusy, InvalidBoardMessage
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bridges.serial.dialect import BoardTopic, Command

log = logging.getLogger(__name__)

AUTO: Final = "auto"
DETECTED: Final = ("frames", "rosserial")
"""The protocols that are tried; boards with other protocols may be disturbed by their questions."""
BAUDS: Final = (57_600, 115_200, 9_600, 38_400, 19_200, 230_400, 250_000, 500_000, 1_000_000)
"""The baud rates of boards, the usual ones first."""
FIRST_TRIAL: Final = 3.0
"""Seconds at the first baud rate after the port was opened: opening it resets most boards, which takes almost two."""
TRIAL: Final = 0.8
"""Seconds at each further baud rate."""
LONGEST_TRIAL: Final = 10.0
"""Seconds at a baud rate at which whole frames arrive, until the board has introduced itself."""
SEARCH_AGAIN: Final = 15.0
"""Seconds without an answer in the protocol that was found, after which the search begins again."""


def make_dialect(protocol: str, baud: int, parameters: Mapping[str, object] | None = None) -> Dialect:
    """The dialect `protocol` at `baud` bits per second; with `auto`, or 0, that which a board is found to have.

    Raises `UnknownDialect`, `BrokenDialect`.
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
        seconds_to_search_again: float = SEARCH_AGAIN,
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
        self.silence = FIRST_TRIAL + TRIAL * len(bauds)
        rates = ", ".join(map(str, self._bauds))
        self.attempt = f"in {' or '.join(protocols)}, at {rates} baud: is the firmware loaded, in another protocol?"

    @property
    def next_tick(self) -> float:
        """When `tick` has to be called at the latest."""
        if self._found is not None:
            again = self._absent_since + self._search_again if not self._unfinished else float("inf")
            return min(again, self._found.next_tick)
        return min(self._next_expiry, self._trial_ends, *(trial.next_tick for trial in self._trials.values()))

    def opened(self, now: float) -> None:
        """Continue with the protocol that was found, or begin to search."""
        self._is_open, self._absent_since = True, now
        if self._found is not None:
            self._found.opened(now)
            self._pass_on(now)
        else:
            self._try(self.baud, now, FIRST_TRIAL)

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
        """These bytes may be an answer in any protocol."""
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
                self._try(self.baud, now, TRIAL)
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
        """Queue a command. Raises `InvalidBoardMessage`, `BoardBusy`."""
        if self._found is None:
            self._enqueue(command)
            return
        self._found.submit(command, now)
        self._unfinished += 1
        self._pass_on(now)

    def respond(self, topic: BoardTopic, payload: bytes, now: float) -> None:
        """Answer a request of the board."""
        if self._found is not None:
            self._found.respond(topic, payload, now)
            self._pass_on(now)

    def outgoing(self) -> bytes:
        """The bytes to send now; during the search those of all protocols."""
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
        if is_heard and now < self._trial_began + LONGEST_TRIAL:
            self._trial_ends = self._trial_began + LONGEST_TRIAL
            return
        self._try(self._bauds[(self._bauds.index(self.baud) + 1) % len(self._bauds)], now, TRIAL)

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
            except (InvalidBoardMessage, BoardBusy) as error:
                self._fail(command, "full" if isinstance(error, BoardBusy) else "unfit", str(error))

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

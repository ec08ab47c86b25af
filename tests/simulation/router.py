"""A simulated Zenoh router, and all that can go wrong between two sessions.

Samples of one session arrive in the order in which they were sent, unless the faults say otherwise; callbacks run on a
thread of the receiving session.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import zenoh

from tests.simulation.chance import FaultDraw
from tests.simulation.messages import Callback, CancellationToken, FifoChannel, RingChannel, Sample, matches
from tests.simulation.queries import PendingGet, Query
from tests.simulation.scheduler import SECOND
from tests.simulation.sessions import Session
from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.simulation.scheduler import Process

LATENCY: Final = (0.0005, 0.004)
SIGNED: Final = ("/rpc/accept", "/rpc/pair", "/rpc/quote", "/rpc/stop")
"""Ends of the keys of services whose requests are signed: anybody may repeat one. Faults happen to these requests."""
LOST_LINK_SECONDS: Final = 2.0
"""How long until the router notices that a session is gone."""


@dataclass
class TransportFaults:
    """How probable each fault of a message is.

    `extra` is the most seconds that a delayed one takes longer, `old` the oldest that somebody repeats.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0
    replay: float = 0.0
    extra: float = 5.0
    old: float = 300.0
    draw: FaultDraw = field(default_factory=FaultDraw)


class Router:
    """The router, with all its sessions."""

    def __init__(self) -> None:
        self.faults = TransportFaults()
        self.sessions: list[Session] = []
        self.is_up = True
        self.tap: Callable[[Sample, Session], None] = lambda sample, sender: None
        self.asked: Callable[[str, bytes, Session], None] = lambda key, payload, sender: None
        """Called with each signed request: its key, its payload, and who sends it."""
        self._stranger: Session | None = None
        self.cut: set[frozenset[str]] = set()
        """Pairs of session names between which nothing passes."""

    def open(self, config: object = None) -> Session:
        """`zenoh.open`."""
        if not self.is_up:
            raise zenoh.ZError("Unable to connect to any of [tcp/simulated:7447]")
        process = scheduler().process
        session = Session(self, process, "outside" if process is None else process.name)
        self.sessions.append(session)
        return session

    def forget(self, session: Session) -> None:
        """A session was closed."""
        if session in self.sessions:
            self.sessions.remove(session)

    def lose(self, process: Process) -> None:
        """A process died: the router notices after a while."""
        for session in [session for session in self.sessions if session.process is process]:
            self.sessions.remove(session)
            session._closed = True
            for token in session.tokens:
                scheduler().call_later(LOST_LINK_SECONDS, self.token_changed, token.selector, zenoh.SampleKind.DELETE)

    def set_up(self, up: bool) -> None:
        """Stop or start the router."""
        self.is_up = up
        for session in list(self.sessions):
            session.set_linked(up)

    def tokens(self) -> list[str]:
        """The keys of all tokens."""
        return [token.selector for session in self.sessions if session.is_linked for token in session.tokens]

    def token_changed(self, key: str, kind: Any, *, but: Session | None = None) -> None:
        """Tell those who watch tokens."""
        for session in self.sessions:
            if session is but or not session.is_linked:
                continue
            for watcher in session.token_watchers:
                if matches(watcher.selector, key):
                    self.later(session, None, watcher.deliver, Sample(key, b"", kind=kind))

    def linked(self, sender: Session, receiver: Session) -> bool:
        """Whether anything passes from one session to another."""
        if sender is receiver:
            return True
        return sender.is_linked and receiver.is_linked and frozenset((sender.name, receiver.name)) not in self.cut

    def later(self, session: Session, sender: Session | None, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function on a session's thread after the network's latency, in the order of the sender."""
        current = scheduler()
        when = current.now_ns + round(current.random.uniform(*LATENCY) * SECOND)
        if sender is not None:
            when = max(when, session.last_arrival.get(sender, 0) + 1)
            session.last_arrival[sender] = when
        current.call_at(when, session.arrive, function, *arguments)

    def publish(self, sample: Sample, sender: Session) -> None:
        """Bring a sample to all subscribers."""
        self.tap(sample, sender)
        key = str(sample.key_expr)
        for session in self.sessions:
            if any(matches(receiver.selector, key) for receiver in session.subscribers):
                if self.linked(sender, session):
                    self._transfer(sample, sender, session)
                else:
                    self.faults.draw.counts["message-cut-off"] += 1

    def _transfer(self, sample: Sample, sender: Session, session: Session) -> None:
        faults, draw = self.faults, self.faults.draw
        if session is sender:
            self.later(session, sender, self.deliver, sample, sender, session)
            return
        if draw("message-dropped", faults.drop):
            return
        if draw("message-duplicated", faults.duplicate):
            self._delayed(sample, sender, session)
        if draw("message-replayed", faults.replay):
            self._delayed(sample, sender, session, most=faults.old)
        if draw("message-delayed", faults.delay):
            self._delayed(sample, sender, session)
            return
        self.later(session, sender, self.deliver, sample, sender, session)

    def _delayed(self, sample: Sample, sender: Session, session: Session, *, most: float = 0.0) -> None:
        """Deliver a sample late: to the session that then has the place of `session`, if its process was restarted."""
        seconds = self.faults.draw.random.uniform(0, most or self.faults.extra)
        scheduler().call_later(seconds, self._deliver_late, sample, sender, session)

    def _deliver_late(self, sample: Sample, sender: Session, session: Session) -> None:
        place = session.name.partition("#")[0]
        for current in self.sessions:
            if current.name.partition("#")[0] == place and current.is_linked:
                current.arrive(self.deliver, sample, sender, current)

    def deliver(self, sample: Sample, sender: Session, session: Session) -> None:
        """Give a sample to the matching subscribers of a session."""
        key = str(sample.key_expr)
        for receiver in list(session.subscribers):
            if matches(receiver.selector, key):
                receiver.deliver(sample)

    def query(
        self, pending: PendingGet, sender: Session, key: str, payload: bytes | None, parameters: dict[str, str]
    ) -> None:
        """Bring a query to all queryables."""
        is_signed = payload is not None and key.endswith(SIGNED)
        if payload is not None and is_signed:
            self.asked(key, payload, sender)
        for session in self.sessions:
            if not self.linked(sender, session):
                continue
            for receiver in session.queryables:
                if matches(receiver.selector, key):
                    pending.outstanding += 1
                    if payload is not None and is_signed and not self._arrives(key, payload):
                        continue
                    query = Query(pending, receiver, payload, parameters)
                    self.later(session, sender, receiver.deliver, query)

    def _arrives(self, key: str, payload: bytes) -> bool:
        """Whether a signed request arrives; a stranger may repeat it later."""
        faults, draw = self.faults, self.faults.draw
        if draw("message-replayed", faults.replay):
            scheduler().call_later(draw.random.uniform(0, faults.old), self._repeat, key, payload)
        return not draw("message-dropped", faults.drop)

    def _repeat(self, key: str, payload: bytes) -> None:
        if self._stranger is None:
            self._stranger = Session(self, None, "stranger")
        self.query(PendingGet(self, self._stranger, key, None), self._stranger, key, payload, {})


def install(router_of: Callable[[], Router]) -> None:
    """Replace Zenoh's entry points for the rest of this process."""
    module: Any = zenoh
    module.open = lambda config: router_of().open(config)
    module.CancellationToken = CancellationToken
    module.handlers.FifoChannel = FifoChannel
    module.handlers.RingChannel = RingChannel
    module.handlers.Callback = Callback

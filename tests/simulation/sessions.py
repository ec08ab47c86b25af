"""A simulated Zenoh session, with the part of Zenoh's Python interface that production code uses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import zenoh

from tests.simulation.messages import (
    CancellationToken,
    FifoChannel,
    Mailbox,
    Reply,
    Sample,
    matches,
)
from tests.simulation.queries import PendingGet
from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.simulation.router import Router
    from tests.simulation.scheduler import Process


class Receiver:
    """A subscriber or queryable: where samples or queries go."""

    def __init__(self, session: Session, selector: str, handler: Any, declared: list[Receiver]) -> None:
        self.session = session
        self.selector = selector
        self._declared = declared
        self.handler: Mailbox | None = Mailbox(handler) if isinstance(handler, FifoChannel) else None
        self.deliver: Callable[[Any], object] = handler if self.handler is None else self.handler.put
        declared.append(self)

    def undeclare(self) -> None:
        """Stop receiving."""
        if self in self._declared:
            self._declared.remove(self)
        if self.handler is not None:
            self.handler.close()

    def __iter__(self) -> Iterator[Any]:
        assert self.handler is not None
        return iter(self.handler)


class Token(Receiver):
    """A liveliness token."""

    def __init__(self, session: Session, key: str) -> None:
        self.session = session
        self.selector = key
        session.tokens.append(self)
        session.router.token_changed(key, zenoh.SampleKind.PUT)

    def undeclare(self) -> None:
        """Withdraw it."""
        if self in self.session.tokens:
            self.session.tokens.remove(self)
            self.session.router.token_changed(self.selector, zenoh.SampleKind.DELETE)


class Session:
    """`zenoh.Session`."""

    def __init__(self, router: Router, process: Process | None, name: str) -> None:
        self.router = router
        self.process = process
        self.name = name
        self.subscribers: list[Receiver] = []
        self.queryables: list[Receiver] = []
        self.tokens: list[Token] = []
        self.token_watchers: list[Receiver] = []
        self.transport_watchers: list[Callable[[Any], object]] = []
        self.is_linked = True
        self._closed = False
        self._zid = f"{scheduler().random.getrandbits(64):016x}"
        self._inbox = Mailbox(FifoChannel(1 << 30))
        self.last_arrival: dict[Session, int] = {}
        scheduler().spawn(self._receive, f"zenoh {name}", process)

    def _receive(self) -> None:
        """The session's thread: callbacks run here, one after the other."""
        for function, arguments in self._inbox:
            function(*arguments)

    def arrive(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function on the session's thread."""
        self._inbox.put((function, arguments))

    def zid(self) -> str:
        """The session's id."""
        return self._zid

    def is_closed(self) -> bool:
        """Whether it was closed."""
        return self._closed

    def close(self) -> None:
        """Close it."""
        if self._closed:
            return
        self._closed = True
        for receiver in (*self.subscribers, *self.queryables, *self.tokens):
            receiver.undeclare()
        self.router.forget(self)
        self._inbox.close()

    def put(
        self, key: Any, payload: bytes, *, encoding: Any = "", allowed_destination: Any = None, **options: Any
    ) -> None:
        """Publish."""
        self._check()
        sample = Sample(str(key), bytes(payload), str(encoding))
        if allowed_destination == zenoh.Locality.SESSION_LOCAL:
            self.router.deliver(sample, self, self)
        else:
            self.router.publish(sample, self)

    def get(
        self,
        selector: Any,
        handler: Any = None,
        *,
        payload: bytes | None = None,
        timeout: float | None = None,
        cancellation_token: CancellationToken | None = None,
        **options: Any,
    ) -> Any:
        """Query."""
        self._check()
        key, _, parameters = str(selector).partition("?")
        pending = PendingGet(self.router, self, key, handler)
        if cancellation_token is not None:
            cancellation_token.add(pending.end)
        parsed = dict(pair.split("=", 1) for pair in parameters.split(";") if "=" in pair)
        self.router.query(pending, self, key, payload, parsed)
        if pending.outstanding == 0:
            pending.end()
        else:
            scheduler().call_later(10.0 if timeout is None else timeout, lambda: self.arrive(pending.time_out))
        return pending.mailbox

    def declare_subscriber(self, selector: Any, handler: Any, **options: Any) -> Receiver:
        """Subscribe."""
        self._check()
        return Receiver(self, str(selector), handler, self.subscribers)

    def declare_queryable(self, selector: Any, handler: Any, **options: Any) -> Receiver:
        """Answer queries."""
        self._check()
        return Receiver(self, str(selector), handler, self.queryables)

    def liveliness(self) -> Liveliness:
        """Tokens."""
        return Liveliness(self)

    @property
    def info(self) -> Any:
        """Links."""
        return self

    def routers_zid(self) -> list[str]:
        """The connected routers."""
        return ["router"] if self.is_linked else []

    def declare_transport_events_listener(self, callback: Callable[[Any], object], *, history: bool = False) -> object:
        """Watch the links."""
        self.transport_watchers.append(callback)
        return callback

    def set_linked(self, linked: bool) -> None:
        """The link to the router broke, or is back."""
        if linked == self.is_linked or self._closed:
            return
        self.is_linked = linked
        kind = zenoh.SampleKind.PUT if linked else zenoh.SampleKind.DELETE
        event = SimpleNamespace(kind=kind, transport=SimpleNamespace(zid="router"))
        for watcher in self.transport_watchers:
            self.arrive(watcher, event)
        for token in self.tokens:
            self.router.token_changed(token.selector, kind, but=self)
        if linked:
            for receiver in self.token_watchers:
                for key in self.router.tokens():
                    self.arrive(receiver.deliver, Sample(key, b""))

    def _check(self) -> None:
        if self._closed:
            raise zenoh.ZError("the session is closed")


class Liveliness:
    """`zenoh.Liveliness`."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def declare_token(self, key: Any) -> Token:
        """Declare that this session is alive on a key."""
        return Token(self._session, str(key))

    def declare_subscriber(self, selector: Any, handler: Any, *, history: bool = False) -> Receiver:
        """Watch tokens."""
        receiver = Receiver(self._session, str(selector), handler, self._session.token_watchers)
        if history and self._session.is_linked:
            for key in self._session.router.tokens():
                if matches(str(selector), key):
                    self._session.arrive(receiver.deliver, Sample(key, b""))
        return receiver

    def get(self, selector: Any, handler: Any = None, **options: Any) -> Mailbox:
        """The tokens now."""
        mailbox = Mailbox(handler or FifoChannel(256))
        for key in self._session.router.tokens():
            if matches(str(selector), key):
                mailbox.put(Reply(Sample(key, b""), None, None))
        mailbox.close()
        return mailbox

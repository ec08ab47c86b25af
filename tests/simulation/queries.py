"""Simulated Zenoh queries: a query at a queryable, and the replies on their way back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from tests.simulation.messages import Callback, FifoChannel, Mailbox, Payload, Reply, Sample, expression

if TYPE_CHECKING:
    from tests.simulation.router import Router
    from tests.simulation.sessions import Receiver, Session


class Query:
    """`zenoh.Query`."""

    def __init__(
        self, pending: PendingGet, receiver: Receiver, payload: bytes | None, parameters: dict[str, str]
    ) -> None:
        self.key_expr = pending.key_expr
        self.payload = None if payload is None else Payload(payload)
        self.parameters = parameters
        self._pending = pending
        self._receiver = receiver
        self._ended = False

    def reply(self, key: Any, payload: bytes, *, encoding: Any = "") -> None:
        """Send a reply."""
        sample = Sample(str(key), bytes(payload), str(encoding))
        self._pending.send(
            self._receiver.session, Reply(sample, None, SimpleNamespace(zid=self._receiver.session.zid()))
        )

    def reply_err(self, payload: bytes, *, encoding: Any = "") -> None:
        """Send an error."""
        error = SimpleNamespace(payload=Payload(bytes(payload)), encoding=str(encoding))
        self._pending.send(
            self._receiver.session, Reply(None, error, SimpleNamespace(zid=self._receiver.session.zid()))
        )

    def drop(self) -> None:
        """End the replies of this queryable."""
        if not self._ended:
            self._ended = True
            self._pending.send(self._receiver.session, None)

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.drop()


class PendingGet:
    """A query that was sent, until its last reply."""

    def __init__(self, router: Router, session: Session, key: str, handler: Any) -> None:
        self.key_expr = expression(key)
        self._router = router
        self._session = session
        self.mailbox = None if isinstance(handler, Callback) else Mailbox(handler or FifoChannel(256))
        self._callback = handler if isinstance(handler, Callback) else None
        self.outstanding = 0
        self._ended = False

    def send(self, sender: Session, reply: Reply | None) -> None:
        """Bring a reply to the one who asked; None is the last of a queryable."""
        if not self._router.linked(sender, self._session):
            return
        self._router.later(self._session, sender, self._arrived, reply)

    def _arrived(self, reply: Reply | None) -> None:
        if self._ended:
            return
        if reply is None:
            self.outstanding -= 1
            if self.outstanding <= 0:
                self.end()
        elif self.mailbox is not None:
            self.mailbox.put(reply)
        else:
            assert self._callback is not None
            self._callback.callback(reply)

    def time_out(self) -> None:
        """The time is over: Zenoh says so with an error."""
        if not self._ended:
            if self.outstanding > 0:
                error = SimpleNamespace(payload=Payload(b"Timeout"), encoding="")
                self.outstanding += 1
                self._arrived(Reply(None, error, None))
            self.end()

    def end(self) -> None:
        """No further reply comes."""
        if self._ended:
            return
        self._ended = True
        if self.mailbox is not None:
            self.mailbox.close()
        elif self._callback is not None and self._callback.drop is not None:
            self._callback.drop()

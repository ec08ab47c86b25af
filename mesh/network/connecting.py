"""Opening a Zenoh session: a blocking call that can't be interrupted, so it is made in short attempts."""

from __future__ import annotations

import logging
import re
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff
from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable, RemoteError
from mesh.network.endpoints import ATTEMPT_TIMEOUT, RECONNECT

if TYPE_CHECKING:
    from mesh.network.endpoints import Endpoints

log = logging.getLogger(__name__)

CAUSE: Final = re.compile(r"\[\S+?: (?P<cause>.+?) at /")
"""The cause in Zenoh's error about a listener."""


class SessionOpening:
    """Opens one session: call `run` in a thread, and `abandon` from another to cancel it."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._abandoned = threading.Event()
        self._outage = OutageLog(log, "router")

    def run(self) -> zenoh.Session:
        """Return the open session. With an infinite timeout, the wait for a router is logged once.

        Raises `NetworkUnavailable` when no router answers within the timeout, `RemoteError` (`not-admitted`) when every
        router that answers rejects this identity, `ConfigurationError`, `ClosedError` when it was abandoned.
        """
        ends = time.monotonic() + self._endpoints.timeout
        backoff = Backoff(RECONNECT)
        while True:
            try:
                session = zenoh.open(self._endpoints.config())
            except zenoh.ZError as error:
                if self._endpoints.mode == "router":
                    raise self._not_listening(error) from None
                pause = backoff.next_delay() or 0.0
                self._check_attempt(ends, pause)
                self._abandoned.wait(pause)
                session = None
            if (opened := self._unless_abandoned(session)) is not None:
                self._outage.recovered("a router answers")
                return opened

    def abandon(self) -> None:
        """Cancel: close the session, now if it is open, otherwise as soon as it opens."""
        with self._lock:
            self._abandoned.set()
            session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def _unless_abandoned(self, session: zenoh.Session | None) -> zenoh.Session | None:
        with self._lock:
            if not self._abandoned.is_set():
                self._session = session
                return session
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        raise ClosedError("opening the network session was cancelled")

    def _check_attempt(self, ends: float, pause: float) -> None:
        """After a failed attempt: raise unless there may be another one after `pause` seconds."""
        self._check_admitted()
        timeout, routers = self._endpoints.timeout, self._endpoints.connect
        if timeout < 0:
            self._outage.failed(NetworkUnavailable(routers, "no answer yet"), "waiting for a router")
        elif time.monotonic() + pause >= ends:
            raise NetworkUnavailable(routers, f"no answer within {timeout:g} s") from None

    def _check_admitted(self) -> None:
        """Raise `RemoteError` if all routers reject this identity: waiting longer would not help."""
        if (tls := self._endpoints.tls) is None:
            return
        from mesh.network.handshake import refusal_by

        refusals = []
        for locator in self._endpoints.connect:
            if (refusal := refusal_by(tls, locator, ATTEMPT_TIMEOUT)) is None:
                return
            refusals.append(f"{locator}: {refusal.text}")
        hint = "set --tls-ca, --tls-certificate and --tls-key to your site's; `aira identity show` prints them"
        raise RemoteError(f"rejected by the Zenoh router at {'; '.join(refusals)}", hint=hint, code="not-admitted")

    def _not_listening(self, error: zenoh.ZError) -> ConfigurationError:
        found = CAUSE.search(str(error))
        why = found["cause"] if found else str(error).split(" at /", 1)[0]
        hint = "is the port taken? choose another with --listen tcp/HOST:PORT"
        return ConfigurationError(
            f"can't listen at {', '.join(self._endpoints.listen)}: {why}", hint=hint, code="listen-failed"
        )

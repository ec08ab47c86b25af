"""Opening a Zenoh session: a blocking call that can't be interrupted, so it is made in short attempts."""

from __future__ import annotations

import logging
import re
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable
from mesh.network.endpoints import ATTEMPT
from mesh.network.errors import NotAdmitted
from mesh.outage_log import OutageLog

if TYPE_CHECKING:
    from mesh.network.endpoints import Endpoints

log = logging.getLogger(__name__)

PAUSE: Final = 0.2
"""Seconds between two attempts."""
CAUSE: Final = re.compile(r"\[\S+?: (?P<cause>.+?) at /")
"""The cause in an error of Zenoh's about a listener."""


class Opening:
    """One way to a session: `run` in a thread; `abandon` from another, when nobody waits for it any more."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._abandoned = threading.Event()
        self._trouble = OutageLog(log, "router")

    def run(self) -> zenoh.Session:
        """The open session.

        Raises `NetworkUnavailable` when no router answers in the endpoints' time, `NotAdmitted` when each that there
        is keeps this identity out, `ConfigurationError` when it can't listen, `ClosedError` when it was abandoned.
        Of who waits for ever the log tells once that it waits.
        """
        ends = time.monotonic() + self._endpoints.timeout
        while True:
            try:
                session = zenoh.open(self._endpoints.config())
            except zenoh.ZError as error:
                if self._endpoints.mode == "router":
                    raise self._not_listening(error) from None
                self._check_patience(ends)
                self._abandoned.wait(PAUSE)
                session = None
            if (opened := self._wanted(session)) is not None:
                self._trouble.recovered("a router answers")
                return opened

    def abandon(self) -> None:
        """Nobody wants the session: close it if it is open, or as soon as it is."""
        with self._lock:
            self._abandoned.set()
            session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def _wanted(self, session: zenoh.Session | None) -> zenoh.Session | None:
        with self._lock:
            if not self._abandoned.is_set():
                self._session = session
                return session
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]
        raise ClosedError("the opening of the network session was abandoned")

    def _check_patience(self, ends: float) -> None:
        """After an attempt without an answer: raise if there is to be no other one after `ends`, seconds."""
        self._check_admitted()
        timeout, routers = self._endpoints.timeout, self._endpoints.connect
        if timeout < 0:
            self._trouble.failed(NetworkUnavailable(routers, "no answer yet"), "waiting for a router")
        elif time.monotonic() + PAUSE >= ends:
            raise NetworkUnavailable(routers, f"no answer within {timeout:g} s") from None

    def _check_admitted(self) -> None:
        """Waiting does not help who is not let in anywhere."""
        if (tls := self._endpoints.tls) is None:
            return
        from mesh.network.handshake import refusal

        refusals = []
        for locator in self._endpoints.connect:
            if (why := refusal(tls, locator, ATTEMPT)) is None:
                return
            refusals.append(f"{locator}: {why}")
        raise NotAdmitted(*refusals)

    def _not_listening(self, error: zenoh.ZError) -> ConfigurationError:
        found = CAUSE.search(str(error))
        cause = found["cause"] if found else str(error).split(" at /", 1)[0]
        return ConfigurationError(
            f"can't listen at {', '.join(self._endpoints.listen)}: {cause}",
            hint="is the port taken? give another with --listen tcp/HOST:PORT",
        )

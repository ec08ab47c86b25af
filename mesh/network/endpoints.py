"""Where a Zenoh session connects and listens, the Zenoh configuration made from that, and opening the session.

Opening is a blocking call that can't be interrupted, so it is made in short attempts.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import zenoh

from mesh.base.outage_log import OutageLog
from mesh.base.retry import Backoff, RetryPolicy
from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable, RemoteError
from mesh.network.locators import TLS_PREFIXES, check_locators

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.network.tls import Tls
    from mesh.settings import NetworkSettings

log = logging.getLogger(__name__)

RECONNECT: Final = RetryPolicy(initial=0.1, factor=1.5, ceiling=0.5)
"""Delays between attempts to reach a router: short, so that an agent is back within a second."""
ATTEMPT_TIMEOUT: Final = 3.0
"""Seconds an endpoint has to answer in one attempt."""
MAX_SESSIONS: Final = 10_000
"""Sessions that a router holds at a time, if the settings say nothing else. Zenoh's own default is 1,000."""
SPARE_DESCRIPTORS: Final = 100
"""Descriptors that a router needs besides those of its sessions."""
CAUSE: Final = re.compile(r"\[\S+?: (?P<cause>.+?) at /")
"""The cause in Zenoh's error about a listener."""
SEND_WAIT: Final = 0.02
"""Seconds that a put waits for room in a client's queue before it drops the message, once until there is room again.

A busy machine may give Zenoh's threads no time for so long. A router waits Zenoh's own 1 ms: while it waits for one
slow client, it serves the others late.
"""


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    """Where a session connects and listens, and with what identity.

    `connect` and `listen` are Zenoh locators (`tcp/HOST:PORT`). `mode` is `client` for agents and `router` for routers.
    A router connects to other routers and retries them as long as it is open. `timeout` is the time in seconds to
    reach a first router; -1 waits forever. `tls` is the identity on `tls/` locators. `access` is Zenoh's
    `access_control`: the rights of each client of this router; `max_sessions` is how many it holds at a time.
    `lease` is the time in seconds after which the other side counts this one as gone if it hears nothing.
    `shared_memory` exchanges large payloads with other processes of the machine in shared memory. Each session then
    locks memory, and a router with 8 MiB of it (`ulimit -l`) admits some 350 sessions.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Literal["client", "router"] = "client"
    timeout: float = 10.0
    tls: Tls | None = None
    access: Mapping[str, Any] | None = None
    max_sessions: int = MAX_SESSIONS
    lease: float = 10.0
    shared_memory: bool = False

    @classmethod
    def from_settings(cls, settings: NetworkSettings) -> Endpoints:
        """The endpoints and identity of a client. Raises `ConfigurationError` for an incomplete identity."""
        tls = None
        if settings.tls_ca or settings.tls_certificate or settings.tls_key:
            from mesh.network.tls import Tls  # loads Python's TLS, some megabytes

            tls = Tls.from_settings(settings)
        return cls(
            connect=settings.connect,
            timeout=settings.connect_timeout,
            tls=tls,
            shared_memory=settings.shared_memory,
        )

    def config(self) -> zenoh.Config:
        """The Zenoh configuration for one attempt to open a session, which tries each endpoint once.

        Zenoh's own timeout is not used: within it, Zenoh tries only the first endpoint. Raises `ConfigurationError`
        for a locator that Zenoh would silently ignore, for a client without a locator, and for unusable certificates.
        """
        self._check()
        config = zenoh.Config()
        for path, value in self.options().items():
            config.insert_json5(path, json.dumps(value))
        return config

    def options(self) -> dict[str, object]:
        """The options of that configuration, by their path in Zenoh's configuration."""
        answer_within = min(self.timeout, ATTEMPT_TIMEOUT) if self.timeout > 0 else ATTEMPT_TIMEOUT
        options: dict[str, object] = {
            "mode": self.mode,
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/timeout_ms": -1 if self.mode == "router" else 0,
            "transport/unicast/open_timeout": max(1, int(answer_within * 1000)),
            "connect/retry": {
                "period_init_ms": round(RECONNECT.initial * 1000),
                "period_max_ms": round(RECONNECT.ceiling * 1000),
                "period_increase_factor": RECONNECT.factor,
            },
            # Batches of 64 kB queued for a link before messages are dropped; of two, the default, some of 100 puts are.
            "transport/link/tx/queue/size/data": 16,
            "transport/shared_memory/enabled": self.shared_memory,
            "transport/unicast/max_sessions": self.max_sessions,
            "transport/link/tx/lease": round(self.lease * 1000),
            "scouting/multicast/enabled": False,
            # Otherwise a router waits half a second for others that scouting might find.
            "scouting/delay": 0,
        }
        if self.mode == "client":
            options["transport/link/tx/queue/congestion_control/drop/wait_before_drop"] = round(SEND_WAIT * 1e6)
        if self.tls is not None:
            options |= {f"transport/link/tls/{name}": value for name, value in self.tls.options(self.mode).items()}
        if self.access is not None:
            options["access_control"] = self.access
        return options

    def _check(self) -> None:
        check_locators(*self.connect, *self.listen)
        if self.mode == "client" and not self.connect:
            raise ConfigurationError("no Zenoh router to connect to", hint="name one with --connect tcp/HOST:PORT")
        if not any(locator.startswith(TLS_PREFIXES) for locator in (*self.connect, *self.listen)):
            return
        from mesh.network.tls import check_files, unusable

        if self.tls is None:
            hint = "give --tls-ca, or tls_ca in the settings"
            raise unusable("a tls/ endpoint needs the site's certificate", hint=hint)
        check_files(self.tls, mode=self.mode)


def room_for_sessions() -> int:
    """The number of sessions for which a router may have file descriptors: by the hard limit."""
    import resource  # Windows has none

    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return sys.maxsize if hard == resource.RLIM_INFINITY else max(0, hard - SPARE_DESCRIPTORS)


def allow_sessions(count: int) -> None:
    """Raise this process's soft limit of file descriptors to what `count` sessions need, as far as it may."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = min(count, room_for_sessions()) + SPARE_DESCRIPTORS
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


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
        from mesh.network.tls import TlsRefusal, shake_hands

        refusals = []
        for locator in self._endpoints.connect:
            if not isinstance(refusal := shake_hands(tls, locator, ATTEMPT_TIMEOUT), TlsRefusal):
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

"""Where a Zenoh session goes, and as what."""

from __future__ import annotations

import json
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import zenoh

from mesh.errors import ConfigurationError
from mesh.network.tls import Tls

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.settings import NetworkSettings

RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
"""Pauses between attempts to reach a router again: short, so that an agent is back within a second."""
ATTEMPT: Final = 3.0
"""Seconds that an endpoint has to answer in one attempt."""
QUEUED: Final = 16
"""Batches of 64 kB that wait for a link before messages are dropped; Zenoh's own two lose some of a hundred puts."""
LOCATOR: Final = re.compile(
    r"(?:tcp|udp|tls|quic|ws)/(?:\[[0-9A-Fa-f:.%]+\]|[^\s:/?#\[\]]+):(?P<port>[0-9]{1,5})(?:[?#]\S*)?"
    r"|(?:unixsock-stream|unixpipe|serial|vsock)/\S+"
)
"""What Zenoh takes for an endpoint; it does not complain of others, it only never connects to them."""
SECURE: Final = ("tls/", "quic/")
"""How locators begin on which both sides show certificates."""
HIGHEST_PORT: Final = 65_535


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    """Where a session goes, and as what.

    `connect` and `listen` are Zenoh locators (`tcp/HOST:PORT`). `mode` is `client` for agents, `router` for the
    process that holds the market together; what that one connects to are other routers, which it goes on trying for
    as long as it is open. `timeout` is in seconds; -1 waits for ever. `tls` is who the session is on
    `tls/` locators. `access` is Zenoh's `access_control`: who may do what on this router.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Literal["client", "router"] = "client"
    timeout: float = 10.0
    tls: Tls | None = None
    access: Mapping[str, Any] | None = None

    @classmethod
    def from_settings(cls, settings: NetworkSettings) -> Endpoints:
        """Where the settings' client connects to, and as whom."""
        return cls(connect=settings.connect, timeout=settings.connect_timeout, tls=tls_of(settings))

    def config(self) -> zenoh.Config:
        """The Zenoh configuration of one attempt to open a session, in which each endpoint is tried once.

        Zenoh's own time limit is not used: within it only the first endpoint is tried, again and again. Raises
        `ConfigurationError` for a locator that Zenoh would silently not use, and for a client without any.
        """
        self._check()
        config = zenoh.Config()
        for path, value in self.options().items():
            config.insert_json5(path, json.dumps(value))
        return config

    def options(self) -> dict[str, object]:
        """The options of that configuration, by their paths in Zenoh's."""
        answer_within = min(self.timeout, ATTEMPT) if self.timeout > 0 else ATTEMPT
        options: dict[str, object] = {
            "mode": self.mode,
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/timeout_ms": -1 if self.mode == "router" else 0,
            "transport/unicast/open_timeout": max(1, int(answer_within * 1000)),
            "connect/retry": RETRY,
            "transport/link/tx/queue/size/data": QUEUED,
            "scouting/multicast/enabled": False,
            # For others that would be found by scouting a router waits half a second.
            "scouting/delay": 0,
        }
        if self.tls is not None:
            options |= {f"transport/link/tls/{name}": value for name, value in self.tls.options(self.mode).items()}
        if self.access is not None:
            options["access_control"] = self.access
        return options

    def _check(self) -> None:
        check_locators(*self.connect, *self.listen)
        if self.mode == "client" and not self.connect:
            raise ConfigurationError("there is no Zenoh router to connect to", hint="name one with --connect")
        if not any(locator.startswith(SECURE) for locator in (*self.connect, *self.listen)):
            return
        if self.tls is not None:
            from mesh.network.handshake import check_files  # with which comes Python's own TLS, some megabytes

            check_files(self.tls, mode=self.mode)
        else:
            raise ConfigurationError(
                "a tls/ endpoint needs the site's certificate", hint="give --tls-ca, or tls_ca in the settings"
            )


def check_locators(*locators: str) -> None:
    """Raise `ConfigurationError` for what Zenoh would silently not use."""
    for locator in locators:
        parts = LOCATOR.fullmatch(locator)
        if parts is None or int(parts["port"] or 0) > HIGHEST_PORT:
            raise ConfigurationError(
                f"{locator!r} is not a Zenoh endpoint",
                hint="write it as tcp/HOST:PORT, for instance tcp/127.0.0.1:7447",
            )


def tls_of(settings: NetworkSettings) -> Tls | None:
    """The identity that the settings name, if they name any."""
    if not settings.tls_ca and (settings.tls_certificate or settings.tls_key):
        raise ConfigurationError("tls_certificate is set, and tls_ca is not", hint="give --tls-ca")
    if not settings.tls_ca:
        return None
    return Tls(
        ca=Path(settings.tls_ca).expanduser(),
        certificate=Path(settings.tls_certificate).expanduser() if settings.tls_certificate else None,
        key=Path(settings.tls_key).expanduser() if settings.tls_key else None,
    )


def free_endpoint() -> str:
    """A loopback TCP locator whose port was free a moment ago, for a router inside this process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

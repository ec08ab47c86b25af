"""Where a Zenoh session goes, and as what."""

from __future__ import annotations

import json
import re
import socket
from dataclasses import dataclass
from typing import Final, Literal

import zenoh

from mesh.errors import ConfigurationError

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
HIGHEST_PORT: Final = 65_535


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    """Where a session goes, and as what.

    `connect` and `listen` are Zenoh locators (`tcp/HOST:PORT`). `mode` is `client` for agents, `router` for the
    process that holds the market together. `timeout` is in seconds; -1 waits for ever.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: Literal["client", "router"] = "client"
    timeout: float = 10.0

    def config(self) -> zenoh.Config:
        """The Zenoh configuration of one attempt to open a session, in which each endpoint is tried once.

        Zenoh's own time limit is not used: within it only the first endpoint is tried, again and again. Raises
        `ConfigurationError` for a locator that Zenoh would silently not use, and for a client without any.
        """
        self._check()
        answer_within = min(self.timeout, ATTEMPT) if self.timeout > 0 else ATTEMPT
        options: dict[str, object] = {
            "mode": self.mode,
            "connect/endpoints": list(self.connect),
            "listen/endpoints": list(self.listen),
            "connect/timeout_ms": 0,
            "transport/unicast/open_timeout": max(1, int(answer_within * 1000)),
            "connect/retry": RETRY,
            "transport/link/tx/queue/size/data": QUEUED,
            "scouting/multicast/enabled": False,
            # For others that would be found by scouting a router waits half a second.
            "scouting/delay": 0,
        }
        config = zenoh.Config()
        for path, value in options.items():
            config.insert_json5(path, json.dumps(value))
        return config

    def _check(self) -> None:
        hint = "write it as tcp/HOST:PORT, for instance tcp/127.0.0.1:7447"
        for locator in (*self.connect, *self.listen):
            parts = LOCATOR.fullmatch(locator)
            if parts is None or int(parts["port"] or 0) > HIGHEST_PORT:
                raise ConfigurationError(f"{locator!r} is not a Zenoh endpoint", hint=hint)
        if self.mode == "client" and not self.connect:
            raise ConfigurationError("there is no Zenoh router to connect to", hint="name one with --connect")


def free_endpoint() -> str:
    """A loopback TCP locator whose port was free a moment ago, for a router inside this process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

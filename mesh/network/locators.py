"""Locators: where Zenoh listens or connects, such as `tcp/127.0.0.1:7447`."""

from __future__ import annotations

import re
import socket
from typing import Final

from mesh.errors import ConfigurationError

LOCATOR: Final = re.compile(
    r"(?P<protocol>tcp|udp|tls|quic|ws)/(?:\[(?P<six>[0-9A-Fa-f:.%]+)\]|(?P<host>[^\s:/?#\[\]]+))"
    r":(?P<port>[0-9]{1,5})(?:[?#]\S*)?"
    r"|(?:unixsock-stream|unixpipe|serial|vsock)/\S+"
)
"""The endpoints that Zenoh connects to. It reports no error for others; it never connects to them."""
TLS_PREFIXES: Final = ("tls/", "quic/")
"""Prefixes of locators on which both sides show certificates."""
WILDCARD_HOSTS: Final = ("0.0.0.0", "::")
"""Hosts that stand for all of a router's addresses; no certificate names them."""


def check_locators(*locators: str) -> None:
    """Raise `ConfigurationError` for a locator that Zenoh would silently ignore."""
    for locator in locators:
        parts = LOCATOR.fullmatch(locator)
        if parts is None or int(parts["port"] or 0) > 65_535:
            raise ConfigurationError(
                f"{locator!r} is not a Zenoh endpoint",
                hint="write it as tcp/HOST:PORT, for instance tcp/127.0.0.1:7447",
            )


def with_free_ports(locators: tuple[str, ...]) -> tuple[str, ...]:
    """The locators with a free port in place of port 0, so that others can be told where this session listens."""
    return tuple(_with_free_port(locator) for locator in locators)


def free_endpoint() -> str:
    """A loopback TCP locator on a port that is free now, for a router inside this process."""
    return _with_free_port("tcp/127.0.0.1:0")


def _with_free_port(locator: str) -> str:
    found = LOCATOR.fullmatch(locator)
    if found is None or found["port"] is None or int(found["port"]):
        return locator
    kind = socket.SOCK_DGRAM if found["protocol"] in ("udp", "quic") else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET6 if found["six"] else socket.AF_INET, kind) as probe:
        probe.bind((found["six"] or found["host"], 0))
        return f"{locator[: found.start('port')]}{probe.getsockname()[1]}{locator[found.end('port') :]}"

"""Free ports on loopback."""

from __future__ import annotations

import atexit
import random
import socket
import struct
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

FIRST: Final = 10_000
BEYOND: Final = 32_700
"""Below the ephemeral ports."""
SHARE: Final = 200
EPHEMERAL: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
"""The first and the last port that Linux gives to connections and to servers that ask for port 0."""
PATIENCE: Final = 0.5
"""Seconds until a port counts as unreachable: it takes microseconds."""
RESET: Final = struct.pack("ii", 1, 0)
"""To linger for no time: a closed connection then does not occupy its ports for a minute."""


def free_port() -> int:
    """A TCP port on 127.0.0.1 that is free, and stays so until a server of the test takes it.

    Each process that runs tests has a share of the ports to itself: what one has chosen and its server is yet to take,
    or has left to come back to, no other chooses.
    """
    return next(port for port in _ports() if _is_free(port))


def free_endpoint() -> str:
    """The locator of a Zenoh router that is to listen on such a port."""
    return f"tcp/127.0.0.1:{free_port()}"


def answers(port: int) -> bool:
    """Whether a server accepts connections on 127.0.0.1:`port`."""
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def hold_unreachable_ports() -> list[int]:
    """Hold the ephemeral ports until this process ends that can't be reached on loopback, and return them.

    A sandbox or a firewall may lose or refuse the connections to one or two. A server that got one by chance would
    never be reached, and its test would wait for minutes. Looking takes two seconds.
    """
    if not EPHEMERAL.exists():
        return []
    first, last = map(int, EPHEMERAL.read_text().split())
    return [port for port in range(first, last + 1) if not _is_reachable(port)]


def _is_reachable(port: int) -> bool:
    """Whether a server on a port can be reached, or has the port already. Others are held."""
    server = socket.socket()
    try:
        server.bind(("127.0.0.1", port))
        server.listen(1)
    except OSError:
        server.close()
        return True
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.settimeout(PATIENCE)
        if client.connect_ex(("127.0.0.1", port)):
            atexit.register(server.close)
            return False
    server.close()
    return True


@cache
def _ports() -> Iterator[int]:
    """The ports of this process, over and over."""
    first = _claim().getsockname()[1]
    return cycle(range(first + 1, first + SHARE))


@cache
def _claim() -> socket.socket:
    """The first port of the share, held until the process ends: that makes the share its own."""
    shares = range(FIRST, BEYOND, SHARE)
    for first in random.sample(shares, len(shares)):
        claim = socket.socket()
        try:
            claim.bind(("127.0.0.1", first))
        except OSError:
            claim.close()
        else:
            atexit.register(claim.close)
            return claim
    raise RuntimeError("no ports are left")


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        # As servers do: connections that ended a moment ago are no hindrance.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True

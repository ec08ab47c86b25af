"""Free ports on loopback."""

from __future__ import annotations

import atexit
import random
import socket
from functools import cache
from itertools import cycle
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

FIRST: Final = 10_000
BEYOND: Final = 32_700
"""The first port that the kernel gives to connections and to servers that ask for port 0."""
SHARE: Final = 200


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

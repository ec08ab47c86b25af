"""The port of a development chain, before the chain listens on it."""

from __future__ import annotations

import socket

from mesh.devchain.errors import PortUnavailable


def check_port(host: str, port: int) -> int:
    """The port, or a free one for 0. Raises `PortUnavailable` when it is taken."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            free: int = probe.getsockname()[1]
            return free
    except OSError as error:
        raise PortUnavailable(host, port, str(error.strerror)) from None

"""Container networks for tests: network bridges that keep their hardware address.

The kernel gives a bridge the lowest address of its ports, so the address changes whenever a container starts or stops.
Other containers send to the old address for ten seconds, and name resolution fails meanwhile. udev fixes the address,
but a machine that runs tests may not have udev.
"""

from __future__ import annotations

import fcntl
import socket
import struct
import threading
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

INTERFACES = Path("/sys/class/net")
FIXED = "3"
"""The `addr_assign_type` of an address that was set explicitly."""
SIOCSIFHWADDR = 0x8924
ARPHRD_ETHER = 1
LOOK_SECONDS = 0.01


@contextmanager
def steady_bridges() -> Iterator[None]:
    """Fix the addresses of podman's bridges, those created in the body included."""
    done = threading.Event()
    watch = threading.Thread(target=_watch, args=(done,), name="addresses of bridges")
    watch.start()
    try:
        yield
    finally:
        done.set()
        watch.join()


def _watch(done: threading.Event) -> None:
    while True:
        for bridge in INTERFACES.glob("podman*"):
            # It may disappear at any moment.
            with suppress(OSError):
                if (bridge / "addr_assign_type").read_text().strip() != FIXED:
                    _fix(bridge.name, (bridge / "address").read_text().strip())
        if done.wait(LOOK_SECONDS):
            return


def _fix(interface: str, address: str) -> None:
    octets = bytes.fromhex(address.replace(":", ""))
    request = struct.pack("16sH14s", interface.encode(), ARPHRD_ETHER, octets)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SIOCSIFHWADDR, request)

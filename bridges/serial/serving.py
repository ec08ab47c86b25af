"""The process of `aira edge`: a session, a line, and signals; no event loop."""

from __future__ import annotations

import logging
import secrets
import signal
import sys
from typing import TYPE_CHECKING, Literal

from bridges.serial.edge import DeviceId, Edge
from bridges.serial.ports import PortName
from mesh.network.opening import Opening
from mesh.running import INTERRUPTED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridges.serial.dialect import Dialect
    from bridges.serial.names import Names
    from mesh.network.endpoints import Endpoints

log = logging.getLogger(__name__)

Protocol = Literal["frames", "rosserial"]


def dialect_of(protocol: Protocol, *, baud: int, parameters: Mapping[str, object]) -> Dialect:
    """The host's side of a protocol, loaded now: a process speaks one of them."""
    if protocol == "rosserial":
        from bridges.serial.rosserial import RosserialDialect

        return RosserialDialect(baud=baud, parameters=parameters)
    from bridges.serial.calling import CallingDialect

    return CallingDialect(baud=baud, session=secrets.randbelow(0xFFFF) + 1)


def serve(
    device: DeviceId,
    port: str,
    *,
    endpoints: Endpoints,
    protocol: Protocol,
    baud: int,
    patience: float,
    parameters: Mapping[str, object],
    names: Names,
) -> None:
    """Serve a board until Ctrl-C or SIGTERM. On the main thread of a process of its own.

    Raises `NetworkUnavailable`, `InputError` for a port that can't be named, `InvalidKey` for such a device.
    """
    name = PortName(port)
    dialect = dialect_of(protocol, baud=baud, parameters=parameters)
    device.key("/present")
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    with Opening(endpoints).run() as session:
        edge = Edge(session, device, name, dialect, baud=baud, patience=patience, names=names)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: edge.stop())
        print(f"edge of {device.agent}: {device.name} on {name}, {protocol}, Zenoh id {session.zid()}", flush=True)
        edge.run()

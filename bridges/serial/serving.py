"""The process of `aira edge`: a session, a line, and signals; no event loop."""

from __future__ import annotations

import logging
import secrets
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from bridges.serial.device_id import PRESENT
from bridges.serial.edge import Edge
from bridges.serial.ports import PortName
from bridges.serial.telling import tell_log
from mesh.cli.output import announce
from mesh.network.connecting import SessionOpening
from mesh.running import INTERRUPTED
from mesh.starting import file_delays
from mesh.telemetry.context import LogSource
from mesh.telemetry.logs import set_process_source
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    import zenoh

    from bridges.serial.device_id import DeviceId
    from bridges.serial.dialect import Dialect
    from bridges.serial.names import Names
    from mesh.network.endpoints import Endpoints
    from mesh.settings import Settings

log = logging.getLogger(__name__)

Protocol = Literal["frames", "rosserial"]
Told: TypeAlias = "Callable[[Edge, zenoh.Session], None]"


@dataclass(frozen=True, kw_only=True)
class Wiring:
    """How a board is reached, and what is spoken with it.

    `baud` in bits per second, `patience` in seconds; `parameters` are what a rosserial sketch may ask for.
    """

    port: str
    protocol: Protocol
    baud: int
    patience: float
    parameters: Mapping[str, object]
    names: Names


def dialect_of(protocol: Protocol, *, baud: int, parameters: Mapping[str, object]) -> Dialect:
    """The host's side of a protocol, loaded now: a process speaks one of them."""
    if protocol == "rosserial":
        from bridges.serial.rosserial import RosserialDialect

        return RosserialDialect(baud=baud, parameters=parameters)
    from bridges.serial.calling import CallingDialect

    return CallingDialect(baud=baud, session=secrets.randbelow(0xFFFF) + 1)


def wait_for_files(settings: Settings) -> None:
    """Wait for the files that the settings name, where they say so. On the main thread, as `serve`."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    for delay in file_delays(settings):
        time.sleep(delay)


@contextmanager
def telling(listen: str) -> Iterator[Told]:
    """Tell metrics and health at `listen` (HOST:PORT), if it is not empty: of what the yielded function is called with.

    Raises `ConfigurationError`. What that needs is loaded only now.
    """
    if not listen:
        yield lambda edge, session: None
        return
    from bridges.serial.metrics import EdgeMetrics
    from mesh.telemetry.serving import open_server

    figures = EdgeMetrics()
    with open_server(listen, figures.families, figures.health):
        yield figures.begin


def serve(device: DeviceId, wiring: Wiring, *, endpoints: Endpoints, told: Told) -> None:
    """Serve a board until Ctrl-C or SIGTERM. On the main thread of a process of its own. `told` is of `telling`.

    Raises `NetworkUnavailable`, `InputError` for a port that can't be named, `InvalidKey` for such a device.
    """
    name = PortName(wiring.port)
    dialect = dialect_of(wiring.protocol, baud=wiring.baud, parameters=wiring.parameters)
    device.key(PRESENT)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    with SessionOpening(endpoints).run() as session:
        edge = Edge(session, device, name, dialect, baud=wiring.baud, patience=wiring.patience, names=wiring.names)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: edge.stop())
        words = f"edge of {device.agent}: {device.name} on {name}, {wiring.protocol}, Zenoh id {session.zid()}"
        told(edge, session)
        set_process_source(LogSource("edge", parse_address(device.agent)))
        announce(log, "edge-started", words, device=device.name)
        with tell_log(session, device):
            edge.run()

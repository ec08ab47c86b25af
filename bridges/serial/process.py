"""The process of `aira edge`: a session, a line, and signals; no event loop."""

from __future__ import annotations

import logging
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bridges.devices import LOG, answer_log_queries
from bridges.serial.detection import AUTO, make_dialect
from bridges.serial.edge import Edge
from bridges.serial.line import PortName
from mesh.cli.output import announce
from mesh.log_context import LogSource
from mesh.network.connecting import SessionOpening
from mesh.running import INTERRUPTED
from mesh.starting import file_delays
from mesh.telemetry.logs import set_process_source
from schemas.address import parse_address
from schemas.agent_keys import DeviceTopicKey

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from bridges.serial.metrics import EdgeMetrics
    from mesh.network.endpoints import Endpoints
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class EdgeOptions:
    """A board: its agent's address and its name in the mesh, how it is reached, and the protocol that it speaks.

    `baud` is in bits per second, 0 if it has to be found, as is the `protocol` "auto"; `patience` is in seconds;
    `parameters` are values that firmware may request; `rename` returns the name in the mesh of a topic of the board.
    """

    agent: str
    name: str
    port: str
    protocol: str
    baud: int
    patience: float
    parameters: Mapping[str, object]
    rename: Callable[[str], str]


def wait_for_files(settings: Settings) -> None:
    """Wait for the files that the settings name, if they say so. On the main thread, like `run_edge`."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    for delay in file_delays(settings):
        time.sleep(delay)


@contextmanager
def serve_metrics(listen: str) -> Iterator[EdgeMetrics | None]:
    """Serve metrics and health at `listen` (HOST:PORT); nothing if it is empty.

    Raises `ConfigurationError`. The server is imported only if it is used.
    """
    if not listen:
        yield None
        return
    from bridges.serial.metrics import EdgeMetrics
    from mesh.telemetry.serving import open_server

    metrics = EdgeMetrics()
    with open_server(listen, metrics.families, metrics.health):
        yield metrics


def run_edge(options: EdgeOptions, *, endpoints: Endpoints, metrics: EdgeMetrics | None = None) -> None:
    """Serve a board until Ctrl-C or SIGTERM. On the main thread of a process of its own.

    Raises `NetworkUnavailable`, `UnknownDialect`, `InputError` for an invalid port name, `InvalidKey` for an invalid
    device.
    """
    agent, name, port = options.agent, options.name, PortName(options.port)
    dialect = make_dialect(options.protocol, options.baud, options.parameters)
    log_key = str(DeviceTopicKey(agent, name, LOG))
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(INTERRUPTED))
    with SessionOpening(endpoints).run() as session:
        edge = Edge(
            session,
            port,
            dialect,
            agent=agent,
            name=name,
            patience=options.patience,
            rename=options.rename,
        )
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: edge.stop())
        protocol = "any protocol" if options.protocol == AUTO else options.protocol
        speed = f"{options.baud} baud" if options.baud else "any baud rate"
        words = f"edge of {agent}: {name} on {port}, {protocol} at {speed}, Zenoh id {session.zid()}"
        if metrics is not None:
            metrics.attach(edge.counters, session)
        set_process_source(LogSource("edge", parse_address(agent)))
        announce(log, "edge-started", words, device=name)
        with answer_log_queries(session, log_key, "edge"):
            edge.run()

"""The HTTP server of /metrics and /health, on threads of its own.

The only module that needs prometheus_client; it is imported when the settings say where to serve.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from prometheus_client import PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry

import mesh
from mesh.errors import AiraError, ConfigurationError
from mesh.log_context import log_event
from mesh.telemetry.metrics import merged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from prometheus_client.core import Metric

    from mesh.telemetry.health import Health
    from mesh.telemetry.metrics import MetricFamily

log = logging.getLogger(__name__)

POLL: Final = 0.2
"""Seconds after which the server notices that it is closed, or that a connection lasts too long."""
TEXT: Final = "text/plain; charset=utf-8"
PROMETHEUS_TYPES: Final = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}


class MetricsNotServed(ConfigurationError, code="metrics-not-served"):
    """The address of metrics and health can't be used; `where` is its HOST:PORT."""

    def __init__(self, where: str, why: object) -> None:
        super().__init__(
            f"can't serve metrics and health at {where}: {why}",
            hint="is the port taken? each server on a machine needs its own: --metrics-listen HOST:PORT",
        )
        self.where = where


class ServerLimits(NamedTuple):
    """What clients may use of the server."""

    seconds: float = 10.0
    """How long a connection may last, whatever is sent over it."""
    connections: int = 32
    """Connections at once; more are closed without an response."""


class HttpResponse(NamedTuple):
    """What a page answers."""

    body: bytes
    content_type: str = TEXT
    status: HTTPStatus = HTTPStatus.OK


class PrometheusCollector(Collector):
    """The metrics of the process (memory, CPU, open files, start time, version), and these families."""

    def __init__(self, families: Iterable[MetricFamily]) -> None:
        self._families = merged(families)
        self._process = (ProcessCollector(registry=None), PlatformCollector(registry=None))

    def collect(self) -> Iterator[Metric]:
        """Each family once. Raises `ValueError` for a name or a label that Prometheus does not accept."""
        for collector in self._process:
            yield from collector.collect()
        version = InfoMetricFamily("aira", "The version of aira-mesh")
        version.add_metric([], {"version": mesh.__version__})
        yield version
        for family in self._families:
            labels = sorted({label for sample in family.samples for label in sample.labels})
            metric = PROMETHEUS_TYPES[family.kind](family.name, family.meaning, labels=labels)
            for sample in family.samples:
                metric.add_metric([sample.labels.get(label, "") for label in labels], sample.value)
            yield metric


def render_metrics(families: Iterable[MetricFamily], *, accept: str = "") -> HttpResponse:
    """The families and the metrics of the process, in the format that a scrape's header `Accept` asks for."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(PrometheusCollector(families))
    encoder, content_type = choose_encoder(accept)
    return HttpResponse(encoder(registry), content_type)


class TelemetryServer:
    """Serves `families` at /metrics and `health` at /health of `host` and `port` (0 takes a free one), with `with`.

    Both are called on threads of the server, several at once. Entering raises `ConfigurationError` if the address can't
    be served.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        families: Callable[[], Iterable[MetricFamily]],
        health: Callable[[], Health],
        limits: ServerLimits = ServerLimits(),  # noqa: B008
    ) -> None:
        self._address = host, port
        self._pages: Mapping[str, Callable[[str], HttpResponse]] = {
            "/metrics": lambda accept: render_metrics(families(), accept=accept),
            "/health": lambda _: health_response(health()),
        }
        self._limits = limits
        self._http: _HttpServer | None = None

    @property
    def url(self) -> str:
        """The address of the pages, without a path."""
        assert self._http is not None, "the server is not open"
        host, port = self._http.server_name, self._http.server_port
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    def __enter__(self) -> Self:
        try:
            self._http = _HttpServer(self._address, self._pages, self._limits)
        except (OSError, OverflowError, UnicodeError) as error:
            where = f"{self._address[0]}:{self._address[1]}"
            why = getattr(error, "strerror", None) or error
            raise MetricsNotServed(where, why) from None
        threading.Thread(target=self._http.serve_forever, args=(POLL,), name="aira-metrics", daemon=True).start()
        log.info(
            "metrics at %s/metrics, health at %s/health",
            self.url,
            self.url,
            extra=log_event("metrics-served", url=self.url),
        )
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http = None


class _HttpServer(ThreadingHTTPServer):
    """Limits how many connections there are and how long each lasts."""

    daemon_threads = True
    block_on_close = False  # closing does not wait for open connections

    def __init__(
        self, address: tuple[str, int], pages: Mapping[str, Callable[[str], HttpResponse]], limits: ServerLimits
    ) -> None:
        self.pages = pages
        self.limits = limits
        self.request_queue_size = limits.connections
        self._lock = threading.Lock()
        self._open: dict[socket.socket, float] = {}
        self.address_family = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0][0]
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """Bind without looking up the host's name, which can take long."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a thread, or close the connection if there are too many."""
        with self._lock:
            admitted = len(self._open) < self.limits.connections
            if admitted:
                self._open[request] = time.monotonic()
        if admitted:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Close connections that last too long: the socket's own timeout begins again with each byte."""
        with self._lock:
            now, most = time.monotonic(), self.limits.seconds
            late = [connection for connection, since in self._open.items() if now - since > most]
        for connection in late:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError as error:  # closed meanwhile
                log.debug("the connection was closed already: %s", error)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A broken connection is no concern of the operator."""
        log.debug("a request for metrics or health broke off", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """One request. No part of it is repeated in the response."""

    server: _HttpServer

    def setup(self) -> None:
        """Set the socket's timeout."""
        self.request.settimeout(self.server.limits.seconds)
        super().setup()

    def do_GET(self) -> None:
        """Answer with the page, or 404."""
        page = self.server.pages.get(self.path.partition("?")[0])
        if page is None:
            self._reply(_plain(HTTPStatus.NOT_FOUND, "not found; the pages are /metrics and /health"))
            return
        try:
            response = page(self.headers.get("Accept", ""))
        except (AiraError, TimeoutError) as error:
            code = getattr(error, "code", "timeout")
            log.warning(
                "metrics or health are unavailable: %s", error, extra=log_event("metrics-unavailable", code=code)
            )
            response = _plain(HTTPStatus.SERVICE_UNAVAILABLE, "unavailable; the server's log says why")
        except Exception:
            log.exception("a request for metrics or health failed", extra=log_event("metrics-failed"))
            response = _plain(HTTPStatus.INTERNAL_SERVER_ERROR, "failed; the server's log says why")
        self._reply(response)

    do_HEAD = do_GET  # noqa: N815

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer another method, or a malformed request."""
        self.close_connection = True
        self._reply(_plain(HTTPStatus(code), HTTPStatus(code).phrase))

    def version_string(self) -> str:
        """The header `Server`."""
        return "aira"

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged: a scrape comes every few seconds."""

    def _reply(self, response: HttpResponse) -> None:
        self.send_response(response.status)
        self.send_header("Content-Type", response.content_type)
        self.send_header("Content-Length", str(len(response.body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(response.body)


def health_response(health: Health) -> HttpResponse:
    """The page /health: 503 if a part does not work."""
    status = HTTPStatus.OK if health.ok else HTTPStatus.SERVICE_UNAVAILABLE
    return HttpResponse(health.encode() + b"\n", "application/json", status)


def _plain(status: HTTPStatus, text: str) -> HttpResponse:
    return HttpResponse(f"{text}\n".encode(), TEXT, status)

"""The HTTP server of /metrics and /health, on a thread with an event loop of its own.

So it answers while the program's own loop is blocked, and serves programs without one. The only module that needs
prometheus_client; it is imported when the settings say where to serve.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Final, Self

from aiohttp import web
from prometheus_client import PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry

import mesh
from mesh.base.door import DoorLimits
from mesh.base.http_server import HttpServer
from mesh.base.log_context import log_event
from mesh.errors import AiraError, ConfigurationError, PortUnavailable
from mesh.telemetry.metrics import merged

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator

    from prometheus_client.core import Metric

    from mesh.telemetry.metrics import Health, MetricFamily


log = logging.getLogger(__name__)

LIMITS: Final = DoorLimits(connections=32, per_address=16)
PROMETHEUS_TYPES: Final = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}


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


def render_metrics(families: Iterable[MetricFamily], *, accept: str = "") -> tuple[bytes, str]:
    """The families and the metrics of the process, in the format that a scrape's `Accept` asks for; and its type."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(PrometheusCollector(families))
    encoder, content_type = choose_encoder(accept)
    return encoder(registry), content_type


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
        limits: DoorLimits = LIMITS,
    ) -> None:
        self._host, self._port = host, port
        self._families = families
        self._health = health
        self._limits = limits

    @property
    def url(self) -> str:
        """The address of the pages, without a path."""
        return f"http://{f'[{self._host}]' if ':' in self._host else self._host}:{self._port}"

    def __enter__(self) -> Self:
        opened: Future[int] = Future()
        self._thread = threading.Thread(
            target=asyncio.run, args=(self._serve(opened),), name="aira-metrics", daemon=True
        )
        self._thread.start()
        try:
            self._port = opened.result()
        except PortUnavailable as error:
            raise ConfigurationError(
                f"can't serve metrics and health at {self._host}:{self._port}: {error.why}",
                hint="is the port taken? each server on a machine needs its own: --metrics-listen HOST:PORT",
                code="metrics-not-served",
            ) from None
        said = log_event("metrics-served", url=self.url)
        log.info("metrics at %s/metrics, health at %s/health", self.url, self.url, extra=said)
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    async def _serve(self, opened: Future[int]) -> None:
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        app = web.Application(middlewares=[self._answer])
        try:
            async with HttpServer(app, self._host, self._port, limits=self._limits) as server:
                opened.set_result(server.port)
                await self._closing.wait()
        except Exception as error:
            opened.set_exception(error)

    @web.middleware
    async def _answer(self, request: web.Request, handler: Callable[[web.Request], Awaitable[object]]) -> web.Response:
        """The page, or why there is none: no part of the request is repeated. What is no request gets plain text."""
        try:
            response = await self._page(request)
        except (AiraError, TimeoutError) as error:
            fields = log_event("metrics-unavailable", code=getattr(error, "code", "timeout"))
            log.warning("metrics or health are unavailable: %s", error, extra=fields)
            response = web.Response(status=503, text="unavailable; the server's log says why\n")
        except Exception:
            log.exception("a request for metrics or health failed", extra=log_event("metrics-failed"))
            response = web.Response(status=500, text="failed; the server's log says why\n")
        response.headers.update({"Cache-Control": "no-store", "Server": "aira"})
        return response

    async def _page(self, request: web.Request) -> web.Response:
        if request.method not in ("GET", "HEAD"):
            return web.Response(status=405, text="method not allowed\n", headers={"Allow": "GET, HEAD"})
        match request.path:
            case "/metrics":
                families = await asyncio.to_thread(self._families)
                body, kind = render_metrics(families, accept=request.headers.get("Accept", ""))
                return web.Response(body=body, headers={"Content-Type": kind})
            case "/health":
                health = await asyncio.to_thread(self._health)
                status = 200 if health.ok else 503
                return web.Response(status=status, body=health.encode() + b"\n", content_type="application/json")
        return web.Response(status=404, text="not found; the pages are /metrics and /health\n")

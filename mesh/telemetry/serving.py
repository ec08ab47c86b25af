"""Metrics and health of the roles of a process: `async with Telemetry(settings.metrics_listen) as telemetry`."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import time
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, NamedTuple, Self, TypeVar

from mesh.base.extras import needs_extra
from mesh.errors import AiraError, ClosedError
from mesh.telemetry.metrics import STARTING, Health, health_metrics, listen_address

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
    from typing import Any

    from mesh.telemetry._server import TelemetryServer
    from mesh.telemetry.metrics import MetricFamily

    Measure = Callable[[], Awaitable[Iterable[MetricFamily]]]
    HealthCheck = Callable[[], Mapping[str, str]]

T = TypeVar("T")

log = logging.getLogger(__name__)


def open_server(
    listen: str, families: Callable[[], Iterable[MetricFamily]], health: Callable[[], Health]
) -> TelemetryServer:
    """A server at `listen` (HOST:PORT), to be used with `with`; it calls both functions on threads of its own.

    Raises `ConfigurationError` if `listen` is not HOST:PORT or prometheus_client is missing; entering it does so if the
    address can't be served. For processes without an event loop; others use `Telemetry`.
    """
    host, port = listen_address(listen)
    with needs_extra("metrics", "metrics_listen"):
        from mesh.telemetry._server import TelemetryServer
    return TelemetryServer(host, port, families=families, health=health)


async def no_metrics() -> tuple[MetricFamily, ...]:
    """The metrics of a role that has none."""
    return ()


class _RoleTelemetry(NamedTuple):
    measure: Measure
    health: HealthCheck


class Telemetry:
    """Serves /metrics and /health at `listen` (HOST:PORT) while it is open; with an empty `listen` it does nothing.

    Each request calls the functions given to `showing`; the event loop has `answer_timeout` seconds for them. Entering
    raises `ConfigurationError` if `listen` is not HOST:PORT, the port is taken, or prometheus_client is missing.
    """

    def __init__(self, listen: str, *, answer_timeout: float = 5.0) -> None:
        self._listen = listen
        self._answer_timeout = answer_timeout
        self._roles: list[_RoleTelemetry] = []
        self._starting = STARTING
        self._server: TelemetryServer | None = None
        self._stack = ExitStack()

    @property
    def url(self) -> str:
        """The address of the pages, without a path; empty if nothing is served."""
        return "" if self._server is None else self._server.url

    async def __aenter__(self) -> Self:
        if self._listen:
            self._loop = asyncio.get_running_loop()
            server = await asyncio.to_thread(open_server, self._listen, self._families, self._health)
            self._server = self._stack.enter_context(server)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._server is not None:
            self._server = None
            await asyncio.to_thread(self._stack.close)

    def starting(self, why: str) -> None:
        """Report what a role that has not started yet waits for."""
        self._starting = f"waits: {why}"

    @contextmanager
    def showing(self, *, health: HealthCheck, measure: Measure = no_metrics) -> Iterator[None]:
        """Serve these metrics and this health, beside those of other roles, until the `with` ends.

        `measure` (metrics now) and `health` (part → `ALIVE`, `OFF`, or what it waits for) are called in the event loop.
        Several roles of one process share metric names and differ in labels and in the names of their parts. An error
        in `measure` is answered with 500 and logged.
        """
        role = _RoleTelemetry(measure, health)
        self._roles.append(role)
        try:
            yield
        finally:
            self._roles.remove(role)

    def parts(self) -> Mapping[str, str]:
        """The parts of all roles; before the first has started, the part `start`."""
        if not self._roles:
            return {"start": self._starting}
        return {part: state for role in self._roles for part, state in role.health().items()}

    async def measure(self) -> Iterable[MetricFamily]:
        """The metrics of all roles, and whether their parts work."""
        families: list[MetricFamily] = []
        for role in tuple(self._roles):
            try:
                families += await role.measure()
            except Exception:
                if role in self._roles:
                    raise
                continue  # the role was closed meanwhile
        return [*families, health_metrics(self.parts())]

    def _families(self) -> Iterable[MetricFamily]:
        """The metrics, asked on a thread of the server. Raises `TimeoutError`, `ClosedError`."""
        return self._in_loop(self.measure())

    def _health(self) -> Health:
        """The health, asked on a thread of the server. Raises `ClosedError`."""
        try:
            return Health.of(self._in_loop(self._parts()))
        except TimeoutError as error:
            return Health.of({"event loop": str(error)})

    async def _parts(self) -> Mapping[str, str]:
        return self.parts()

    def _in_loop(self, work: Coroutine[Any, Any, T]) -> T:
        try:
            future = asyncio.run_coroutine_threadsafe(work, self._loop)
        except RuntimeError:  # the loop is closed
            work.close()
            raise ClosedError("the program has ended") from None
        try:
            return future.result(self._answer_timeout)
        except concurrent.futures.CancelledError:
            raise ClosedError("the program is ending") from None
        except concurrent.futures.TimeoutError:
            future.cancel()
            raise TimeoutError(f"the event loop has not answered within {self._answer_timeout:g} s") from None


class CachedMetrics:
    """Metrics that the node is asked for at most every `max_age` seconds, left out if it does not answer in time."""

    def __init__(self, ask: Measure, *, max_age: float) -> None:
        self._ask = ask
        self._max_age = max_age
        self._families: tuple[MetricFamily, ...] = ()
        self._asked_at = float("-inf")

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics, not older than `max_age`."""
        if time.monotonic() - self._asked_at >= self._max_age:
            self._asked_at = time.monotonic()
            try:
                async with asyncio.timeout(1.0):
                    self._families = tuple(await self._ask())
            except (AiraError, TimeoutError) as error:
                log.debug("metrics of the chain are left out: %s", error)
                self._families = ()
        return self._families

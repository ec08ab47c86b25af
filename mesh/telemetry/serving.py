"""Metrics and health of a role in an event loop: `async with Telemetry(settings.metrics_listen) as telemetry`."""

from __future__ import annotations

import asyncio
import concurrent.futures
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final, NamedTuple, Self, TypeVar

from mesh.errors import ClosedError
from mesh.telemetry.health import STARTING, Health, up

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
    from types import TracebackType
    from typing import Any

    from mesh.telemetry.families import Family
    from mesh.telemetry.server import Server

    Measure = Callable[[], Awaitable[Iterable[Family]]]
    AgentComponents = Callable[[], Mapping[str, str]]

T = TypeVar("T")

ANSWERED_WITHIN: Final = 5.0
"""Seconds that the event loop may take to answer."""
SILENT: Final = Health.of({"event loop": f"has not answered within {ANSWERED_WITHIN:g} s"})


async def no_figures() -> tuple[Family, ...]:
    """The figures of a role that has none yet."""
    return ()


class _Shown(NamedTuple):
    """What one role of the process shows."""

    measure: Measure
    health: AgentComponents


class Telemetry:
    """Serves /metrics and /health at `listen` (HOST:PORT) while it is open; with an empty `listen` it does nothing.

    What is served is `showing`, asked for anew each time. Entering raises `ConfigurationError` for a text that is no
    HOST:PORT, a port that is taken, a missing prometheus_client.
    """

    def __init__(self, listen: str) -> None:
        self._listen = listen
        self._shown: list[_Shown] = []
        self._starting = STARTING
        self._server: Server | None = None
        self._stack = ExitStack()

    @property
    def url(self) -> str:
        """Where the pages are, without a path; empty where nothing is served."""
        return "" if self._server is None else self._server.url

    async def __aenter__(self) -> Self:
        if self._listen:
            from mesh.telemetry.opening import open_server

            self._loop = asyncio.get_running_loop()
            server = await asyncio.to_thread(open_server, self._listen, self._families, self._health)
            self._server = self._stack.enter_context(server)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server = None
            await asyncio.to_thread(self._stack.close)

    def starting(self, why: str) -> None:
        """Say what a start waits for that has not come to its end."""
        self._starting = f"waits: {why}"

    @contextmanager
    def showing(self, *, health: AgentComponents, measure: Measure = no_figures) -> Iterator[None]:
        """Show these figures and parts, beside those that are shown already, until the `with` ends.

        `measure` (figures now) and `health` (part → `ALIVE`, `OFF`, or what it waits for) are called in the event loop.
        Several roles of one process have the same figures with other labels, and parts of other names. What `measure`
        raises becomes the answer 500, and an event of the log.
        """
        shown = _Shown(measure, health)
        self._shown.append(shown)
        try:
            yield
        finally:
            self._shown.remove(shown)

    def parts(self) -> Mapping[str, str]:
        """The parts of all that is shown; of who shows nothing yet, that it starts."""
        if not self._shown:
            return {"start": self._starting}
        return {part: state for shown in self._shown for part, state in shown.health().items()}

    async def measure(self) -> Iterable[Family]:
        """The figures of all that is shown, and whether its parts are well."""
        families: list[Family] = []
        for shown in tuple(self._shown):
            try:
                families += await shown.measure()
            except Exception:
                if shown in self._shown:
                    raise
                continue  # it was being closed
        return [*families, up(self.parts())]

    def _families(self) -> Iterable[Family]:
        """The figures, on a thread of the server's. Raises `TimeoutError`, `ClosedError`."""
        return self._in_loop(self.measure())

    def _health(self) -> Health:
        """How it is, on a thread of the server's. Raises `ClosedError`."""
        try:
            return Health.of(self._in_loop(self._parts()))
        except TimeoutError:
            return SILENT

    async def _parts(self) -> Mapping[str, str]:
        return self.parts()

    def _in_loop(self, work: Coroutine[Any, Any, T]) -> T:
        try:
            asked = asyncio.run_coroutine_threadsafe(work, self._loop)
        except RuntimeError:  # the loop is closed
            work.close()
            raise ClosedError("the program has come to its end") from None
        try:
            return asked.result(ANSWERED_WITHIN)
        except concurrent.futures.CancelledError:
            raise ClosedError("the program comes to its end") from None
        except concurrent.futures.TimeoutError:
            asked.cancel()
            raise TimeoutError(f"the event loop has not answered within {ANSWERED_WITHIN:g} s") from None

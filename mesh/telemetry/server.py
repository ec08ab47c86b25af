"""The HTTP side of metrics and health: two pages, read only, on threads of their own. Loaded where they are served."""

from __future__ import annotations

import logging
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from mesh.errors import AiraError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import TracebackType

    from mesh.telemetry.health import Health

log = logging.getLogger(__name__)

PATIENCE: Final = 10.0
"""Seconds that a connection may last, whatever comes over it."""
CONNECTIONS: Final = 32
"""Connections at once; more are closed unanswered."""
LOOK: Final = 0.2
"""Seconds between two looks at whether the server is to end, and at which connections last too long."""
TEXT: Final = "text/plain; charset=utf-8"


class Answer(NamedTuple):
    """What a page says."""

    body: bytes
    content_type: str = TEXT
    status: HTTPStatus = HTTPStatus.OK


class Server:
    """Serves `metrics` at /metrics and `health` at /health of `host` and `port` (0 takes a free one), with `with`.

    Both are called on threads of the server, several at once; `metrics` with the header `Accept` of who asks. Entering
    raises `ConfigurationError` when nothing can be served there.
    """

    def __init__(self, host: str, port: int, *, metrics: Callable[[str], Answer], health: Callable[[], Health]) -> None:
        self._address = host, port
        self._pages: Mapping[str, Callable[[str], Answer]] = {"/metrics": metrics, "/health": lambda _: told(health())}
        self._http: _Http | None = None

    @property
    def url(self) -> str:
        """Where the pages are, without a path."""
        assert self._http is not None, "the server is not open"
        host, port = self._http.server_name, self._http.server_port
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    def __enter__(self) -> Self:
        try:
            self._http = _Http(self._address, self._pages)
        except (OSError, OverflowError, UnicodeError) as error:
            where = f"{self._address[0]}:{self._address[1]}"
            why = getattr(error, "strerror", None) or error
            raise ConfigurationError(
                f"can't tell metrics and health at {where}: {why}",
                hint="is the port taken? each server of a machine needs one of its own: --metrics-listen HOST:PORT",
            ) from None
        threading.Thread(target=self._http.serve_forever, args=(LOOK,), name="aira-metrics", daemon=True).start()
        log.info("metrics at %s/metrics, health at %s/health", self.url, self.url)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http = None


class _Http(ThreadingHTTPServer):
    """A server that bears any number of clients, and slow ones."""

    daemon_threads = True
    block_on_close = False  # who is still being answered must not hold up the end
    request_queue_size = CONNECTIONS

    def __init__(self, address: tuple[str, int], pages: Mapping[str, Callable[[str], Answer]]) -> None:
        self.pages = pages
        self._lock = threading.Lock()
        self._open: dict[socket.socket, float] = {}
        self.address_family = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0][0]
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """Without a look at the name service for the host's name, which may take its time."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a thread, unless too many are being answered."""
        with self._lock:
            admitted = len(self._open) < CONNECTIONS
            if admitted:
                self._open[request] = time.monotonic()
        if admitted:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """The end of a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Break off connections that last too long: each byte of a slow one would grant it another timeout."""
        with self._lock:
            late = [connection for connection, since in self._open.items() if time.monotonic() - since > PATIENCE]
        for connection in late:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError as error:  # it has ended meanwhile
                log.debug("a connection had ended: %s", error)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """What happens to a connection concerns nobody but who asked."""
        log.debug("a question for metrics or health broke off", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """One question. Nothing of it comes back in the answer."""

    server: _Http
    timeout = PATIENCE

    def do_GET(self) -> None:
        """Answer with the page, or that there is none."""
        page = self.server.pages.get(self.path.partition("?")[0])
        if page is None:
            self._reply(_plain(HTTPStatus.NOT_FOUND, "there is /metrics, and /health"))
            return
        try:
            answer = page(self.headers.get("Accept", ""))
        except (AiraError, TimeoutError) as error:
            log.warning("metrics or health can't be told now: %s", error)
            answer = _plain(HTTPStatus.SERVICE_UNAVAILABLE, "this can't be told now; the server's log says why")
        except Exception:
            log.exception("a question for metrics or health can't be answered")
            answer = _plain(HTTPStatus.INTERNAL_SERVER_ERROR, "this failed; the server's log says why")
        self._reply(answer)

    do_HEAD = do_GET  # noqa: N815

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What is no question that can be answered: another method, a request that is none."""
        self.close_connection = True
        self._reply(_plain(HTTPStatus(code), HTTPStatus(code).phrase))

    def version_string(self) -> str:
        """What the server calls itself."""
        return "aira"

    def log_message(self, format: str, *args: Any) -> None:
        """A scrape every few seconds is no event."""

    def _reply(self, answer: Answer) -> None:
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.content_type)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)


def told(health: Health) -> Answer:
    """The page of a role's health: 503 where a part is not well."""
    status = HTTPStatus.OK if health.ok else HTTPStatus.SERVICE_UNAVAILABLE
    return Answer(health.encode() + b"\n", "application/json", status)


def _plain(status: HTTPStatus, words: str) -> Answer:
    return Answer(f"{words}\n".encode(), TEXT, status)

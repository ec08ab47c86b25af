"""The page's HTTP server: what is open, who may do what, and the protection against other sites' pages."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import msgspec
from aiohttp import web

from bridges.web.answers import answer
from bridges.web.api import Api
from bridges.web.errors import (
    InvalidRequest,
    LoginRequired,
    PageNotFound,
    TooManyRequests,
    WrongHost,
    WrongOrigin,
    status_of,
)
from bridges.web.files import Files
from bridges.web.jobs import Views
from bridges.web.logins import Logins
from bridges.web.market import Market
from bridges.web.options import is_loopback
from bridges.web.orders import OrderPublisher
from bridges.web.stream import Stream
from mesh.agent.status import WatcherStatus
from mesh.background import Background
from mesh.errors import AiraError
from mesh.flood import Rate, RateLimiter
from mesh.log_context import log_event
from mesh.role import Lifecycle
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from contextlib import AsyncExitStack

    from bridges.web.components import WebComponents
    from bridges.web.options import WebOptions
    from mesh.telemetry.metrics import MetricFamily

    Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

log = logging.getLogger(__name__)

OWN_HEADER: Final = "X-Aira-Request"
REQUESTS: Final = Rate(per_second=50, burst=400)
"""Requests of one address."""
REQUESTS_IN_TOTAL: Final = Rate(per_second=500, burst=2000)
LONGEST_BODY: Final = 1 << 18
"""Bytes of a body that is no objective."""
AGENTS_INTERVAL: Final = 3.0
"""Seconds between two lists of agents on the stream."""
VIEWERS: Final = ("https://app.foxglove.dev",)
"""Sites that may read files here: a link of the page opens a recording there."""
VIEWED: Final = re.compile(r"/api/v1/files/\w+/recording\.\w+")
OPEN_PATHS: Final = ("/api/v1/session", "/api/v1/openapi.json")
"""Parts of the interface that need no login."""


class PageServer(Lifecycle):
    """Serves the page: `async with PageServer(components, options) as server`; then `server.url`."""

    title = "page server"

    def __init__(self, components: WebComponents, options: WebOptions) -> None:
        options.check()
        self.components = components
        self.options = options
        self.stream = Stream()
        self.market = Market(components, self.stream, from_block=options.from_block)
        self.files = Files(components)
        self.views = Views(components, self.market, self.files)
        self.publisher = OrderPublisher(components, self.market)
        self._status = WatcherStatus(components.network, components.channel, components.drops)
        self.url = ""
        self._hosts: frozenset[str] = frozenset()
        self._logins = Logins(options)
        self._limiter = RateLimiter(per_sender=REQUESTS, total=REQUESTS_IN_TOTAL)
        self._chain_asked = float("-inf")
        self._has_chain = True

    async def _open(self, stack: AsyncExitStack) -> None:
        enter = stack.enter_async_context
        await enter(self.market)
        await enter(self.publisher)
        tasks = await enter(Background())
        tasks.start(self._show_agents(), "page: agents")
        tasks.start(self.components.drops.run(), "page: drops")
        app = web.Application(middlewares=[self._guarded], client_max_size=LONGEST_BODY)
        app.add_routes([*Api(self).routes(), web.post("/api/v1/session", self._logins.log_in)])
        app.router.add_get("/{path:.*}", self._static)
        app.on_shutdown.append(lambda _: self.stream.close())
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        await runner.setup()
        stack.push_async_callback(runner.cleanup)
        site = web.TCPSite(runner, self.options.host, self.options.port, ssl_context=self._logins.tls())
        await site.start()
        port = runner.addresses[0][1]
        host = f"[{self.options.host}]" if ":" in self.options.host else self.options.host
        self.url = f"{'https' if self.options.certificate else 'http'}://{host}:{port}"
        own = {f"{host}:{port}"}
        if is_loopback(self.options.host):
            own |= {f"{name}:{port}" for name in ("localhost", "127.0.0.1", "[::1]")}
        self._hosts = frozenset(own)

    def role_of(self, request: web.Request) -> str:
        """`operator` or `anybody`: what the session of a request may do."""
        return self._logins.role_of(request) or "anybody"

    async def measure(self) -> tuple[MetricFamily, ...]:
        """Its metrics now."""
        return await self._status.measure(())

    def health(self) -> dict[str, str]:
        """The state of its parts."""
        return {**self._status.health(), "chain": ALIVE if self._has_chain else "waits for the node"}

    async def has_chain(self) -> bool:
        """Whether the node answers; asked once in three seconds."""
        if time.monotonic() - self._chain_asked > AGENTS_INTERVAL:
            self._chain_asked = time.monotonic()
            try:
                async with asyncio.timeout(2.0):
                    await self.components.chain.block_number()
                self._has_chain = True
            except (AiraError, TimeoutError):
                self._has_chain = False
        return self._has_chain

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request, answer errors in JSON, and add the headers that protect the page."""
        try:
            self._check(request)
            response = web.Response(status=204) if _is_viewer(request, "OPTIONS") else await handler(request)
        except AiraError as error:
            response = _failure(error)
        except web.HTTPRequestEntityTooLarge:
            response = _failure(InvalidRequest(f"a body has at most {LONGEST_BODY} bytes"))
        except web.HTTPException as error:
            response = _failure(PageNotFound(error.reason)) if error.status == 404 else error
        except (ConnectionError, asyncio.CancelledError):
            raise
        except Exception:
            log.exception("a request failed", extra=log_event("page-request-failed", path=request.path))
            response = answer({"error": {"code": "error", "message": "the server failed; see its log", "hint": ""}})
            response.set_status(500)
        if not response.prepared:
            for name, value in self._headers().items():
                response.headers.setdefault(name, value)
            if _is_viewer(request):
                response.headers.update(_VIEWER_HEADERS | {"Access-Control-Allow-Origin": request.headers["Origin"]})
            if request.path.startswith("/api/"):
                response.headers.setdefault("Cache-Control", "no-store")
        return response

    def _check(self, request: web.Request) -> None:
        sender = request.remote or ""
        if not self._limiter.allow(sender):
            self.components.drops.count("page-request", sender)
            raise TooManyRequests("too many requests", hint="wait a moment")
        if not self._is_own(request.host):
            raise WrongHost(f"this server is not {request.host[:80]!r}", hint="name it with --name")
        if not _is_viewer(request):
            self._check_site(request)
        is_api = request.path.startswith("/api/") or request.path == "/rpc"
        if (
            is_api
            and request.path not in OPEN_PATHS
            and self._logins.is_needed
            and self._logins.role_of(request) is None
        ):
            raise LoginRequired("log in first", hint="the token is in the server's token file")

    def _check_site(self, request: web.Request) -> None:
        """Refuse pages of other sites."""
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.host:
            raise WrongOrigin("pages of other sites may not use this server")
        is_api = request.path.startswith("/api/") or request.path == "/rpc"
        if is_api and request.headers.get("Sec-Fetch-Site") == "cross-site":
            raise WrongOrigin("pages of other sites may not use this server")
        if request.method not in ("GET", "HEAD"):
            if request.headers.get(OWN_HEADER) != "1":
                raise WrongOrigin(f"the header {OWN_HEADER} is missing")
            if request.content_type not in ("application/json", "application/octet-stream"):
                raise InvalidRequest("a body is application/json, or application/octet-stream for an objective")

    def _is_own(self, host: str) -> bool:
        """Whether a request for this host is meant for this server: a name without a port is one at any port."""
        return host in self._hosts or not {host, host.rpartition(":")[0]}.isdisjoint(self.options.names)

    def _headers(self) -> dict[str, str]:
        frames = " ".join(self.options.embed) or "'none'"
        return {
            "Content-Security-Policy": "default-src 'self'; style-src 'self'; img-src 'self' data: blob:;"
            f" object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors {frames}",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
        }

    async def _static(self, request: web.Request) -> web.StreamResponse:
        """A built file; any other path that looks like no file is the page itself, which has its own routes."""
        root = self.options.static
        path = (root / request.match_info["path"].lstrip("/")).resolve()
        if path.is_file() and path.is_relative_to(root.resolve()):
            return web.FileResponse(path, headers={"Cache-Control": "no-cache"})
        index = root / "index.html"
        if "." in request.path.rpartition("/")[2] or request.path.startswith("/api/") or not index.is_file():
            raise PageNotFound(f"there is no {request.path[:80]}")
        return web.FileResponse(index, headers={"Cache-Control": "no-cache"})

    async def _show_agents(self) -> None:
        """Publish the agents while somebody looks at them."""
        last: bytes = b""
        while True:
            await asyncio.sleep(AGENTS_INTERVAL)
            await self.has_chain()
            if not self.stream.has_subscribers("agents"):
                continue
            try:
                agents = await self.views.agents()
            except AiraError as error:
                log.debug("the agents can't be listed: %s", error)
                continue
            if (text := msgspec.json.encode(agents)) != last:
                last = text
                self.stream.publish("agents", "agents", agents)


_VIEWER_HEADERS: Final = {
    "Access-Control-Allow-Headers": "Range",
    "Access-Control-Allow-Private-Network": "true",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Vary": "Origin",
}


def _is_viewer(request: web.Request, *methods: str) -> bool:
    """Whether a site for recordings reads one. It gets no cookie: where people log in, it is refused."""
    return (
        request.headers.get("Origin") in VIEWERS
        and VIEWED.fullmatch(request.path) is not None
        and request.method in (methods or ("GET", "HEAD", "OPTIONS"))
    )


def _failure(error: AiraError) -> web.Response:
    facts = {"code": error.code, "message": str(error), "hint": error.hint}
    if (reason := getattr(error, "reason", None)) is not None and isinstance(reason, str):
        facts["reason"] = reason
    return answer({"error": facts}, status=status_of(error))

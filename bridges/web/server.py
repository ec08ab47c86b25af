"""The page's HTTP server: what is open, who may do what, and the protection against other sites' pages."""

from __future__ import annotations

import asyncio
import logging
import re
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from aiohttp import web

from bridges.serving import is_loopback
from bridges.web._access import SENDER, Logins, WebError, WebOptions, answer, status_of
from bridges.web._api import Api
from bridges.web.components import opened
from mesh.base.door import DoorLimits, network_of
from mesh.base.flood import Rate, RateLimiter
from mesh.base.http_server import HttpServer
from mesh.base.lifecycle import Lifecycle
from mesh.base.log_context import log_event
from mesh.errors import AiraError, public_text
from mesh.role.program import WatcherStatus
from schemas.status import ALIVE

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from contextlib import AsyncExitStack

    from bridges.web.components import WebComponents
    from mesh.agent.agent import Agent
    from mesh.chain import Chain
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily

    Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


log = logging.getLogger(__name__)

OWN_HEADER: Final = "X-Aira-Request"
REQUESTS: Final = Rate(per_second=50, burst=400)
"""Requests of one login, or of one address without a login."""
REQUESTS_IN_TOTAL: Final = Rate(per_second=500, burst=2000)
"""Those without a login."""
REFUSED: Final = Rate(per_second=10, burst=100)
"""Requests of one address that are refused, or that a page of another site makes: they use up nobody's own."""
COUNTED: Final = frozenset({"invalid-request", "login-required", "wrong-host", "wrong-origin"})
"""The codes of requests that are refused."""
LOGIN: Final = "/api/v1/session"
LONGEST_BODY: Final = 1 << 18
"""Bytes of a body that is no objective."""
VIEWERS: Final = ("https://app.foxglove.dev",)
"""Sites that may read files here: a link of the page opens a recording there."""
VIEWED: Final = re.compile(r"/api/v1/files/\w+/recording\.\w+")
OPEN_PATHS: Final = (LOGIN, "/api/v1/openapi.json")
"""Parts of the interface that need no login."""


class PageServer(Lifecycle):
    """Serves the page: `async with PageServer(components, options) as server`; then `server.url`."""

    title = "page server"

    def __init__(self, components: WebComponents, options: WebOptions) -> None:
        options.check()
        self.components = components
        self.options = options
        self.url = ""
        self._logins = Logins(options, has_account=components.agent is not None)
        self.api = Api(components, options, self._logins)
        self._status = WatcherStatus(components.network, components.channel, components.drops)
        self._hosts: frozenset[str] = frozenset()
        self._limiter = RateLimiter(per_sender=REQUESTS, total=REQUESTS_IN_TOTAL)
        self._of_logins = RateLimiter(per_sender=REQUESTS)
        self._refused = RateLimiter(per_sender=REFUSED)

    async def _open(self, stack: AsyncExitStack) -> None:
        enter = stack.enter_async_context
        await enter(self.api)
        app = web.Application(middlewares=[self._guarded], client_max_size=LONGEST_BODY)
        app.add_routes([*self.api.routes(), web.post(LOGIN, self._logins.log_in)])
        app.router.add_get("/{path:.*}", self._static)
        app.on_shutdown.append(lambda _: self.api.stream.close())
        tls = await asyncio.to_thread(self._logins.tls)
        limits = DoorLimits(proxies=self.options.proxies)
        listen = self.options.host, self.options.port
        port = (await enter(HttpServer(app, *listen, tls=tls, limits=limits, option="--listen HOST:PORT"))).port
        host = f"[{self.options.host}]" if ":" in self.options.host else self.options.host
        self.url = f"{'https' if self.options.certificate else 'http'}://{host}:{port}"
        own = {f"{host}:{port}"}
        if is_loopback(self.options.host):
            own |= {f"{name}:{port}" for name in ("localhost", "127.0.0.1", "[::1]")}
        self._hosts = frozenset(own)

    async def measure(self) -> tuple[MetricFamily, ...]:
        return await self._status.measure(())

    def health(self) -> dict[str, str]:
        return {**self._status.health(), "chain": ALIVE if self.api.chain_answers else "waits for the node"}

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request, answer errors in JSON, and add the headers that protect the page."""
        try:
            self._check(request)
            response = web.Response(status=204) if _is_viewer(request, "OPTIONS") else await handler(request)
        except AiraError as error:
            response = _failure(self._counted(request, error) if error.code in COUNTED else error)
        except web.HTTPRequestEntityTooLarge:
            response = _failure(WebError(f"a body has at most {LONGEST_BODY} bytes"))
        except web.HTTPException as error:
            missing = error.status == 404
            response = _failure(WebError(error.reason, code="page-not-found") if missing else WebError(error.reason))
            response.set_status(error.status)
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
        host = request.host
        # A name without a port is one at any port.
        if host not in self._hosts and {host, host.rpartition(":")[0]}.isdisjoint(self.options.names):
            raise WebError(f"this server is not {host[:80]!r}", hint="name it with --name", code="wrong-host")
        if not _is_viewer(request):
            self._check_site(request)
        login = self._logins.login_of(request)
        if _is_api(request) and request.path not in OPEN_PATHS and self._logins.is_needed and login is None:
            raise WebError("log in first", hint="the token is in the server's token file", code="login-required")
        address = self._address_of(request)
        request[SENDER] = address if login is None else login.sender
        if request.path == LOGIN:  # wrong tokens are refused, and the right one never
            return
        if _is_foreign(request):
            allowed = self._refused.allow(address)
        elif login is None:
            allowed = self._limiter.allow(address)
        else:
            allowed = self._of_logins.allow(login.sender)
        if not allowed:
            raise self._too_many(address)

    def _counted(self, request: web.Request, refusal: AiraError) -> AiraError:
        """What a refused request is answered: of too many only that they are."""
        address = self._address_of(request)
        return refusal if self._refused.allow(address) else self._too_many(address)

    def _too_many(self, address: str) -> WebError:
        self.components.drops.count("page-request", address)
        return WebError("too many requests", hint="wait a moment", code="too-many-requests")

    def _address_of(self, request: web.Request) -> str:
        """Who asks: the address of the connection, or what a proxy of ours says."""
        path = [request.remote or ""]
        for line in request.headers.getall("X-Forwarded-For", ()):
            path[:-1] += [one.strip() for one in line.split(",")]
        address = next((one for one in reversed(path) if one not in self.options.proxies), path[0])
        return network_of(address[:64])

    def _check_site(self, request: web.Request) -> None:
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.host:
            raise WebError("pages of other sites may not use this server", code="wrong-origin")
        if _is_api(request) and _is_foreign(request):
            raise WebError("pages of other sites may not use this server", code="wrong-origin")
        if request.method not in ("GET", "HEAD"):
            if request.headers.get(OWN_HEADER) != "1":
                raise WebError(f"the header {OWN_HEADER} is missing", code="wrong-origin")
            if request.content_type not in ("application/json", "application/octet-stream"):
                raise WebError("a body is application/json, or application/octet-stream for an objective")

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
        index = root / "index.html"
        try:
            path = (root / request.match_info["path"].lstrip("/")).resolve()
            if path.is_file() and path.is_relative_to(root.resolve()):
                return web.FileResponse(path, headers={"Cache-Control": "no-cache"})
        except (OSError, ValueError):  # no file can have this name
            raise WebError(f"there is no {request.path[:80]!r}", code="page-not-found") from None
        if "." in request.path.rpartition("/")[2] or request.path.startswith("/api/") or not index.is_file():
            raise WebError(f"there is no {request.path[:80]}", code="page-not-found")
        return web.FileResponse(index, headers={"Cache-Control": "no-cache"})


_VIEWER_HEADERS: Final = {
    "Access-Control-Allow-Headers": "Range",
    "Access-Control-Allow-Private-Network": "true",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Vary": "Origin",
}


def _is_api(request: web.Request) -> bool:
    return request.path.startswith("/api/") or request.path == "/rpc"


def _is_foreign(request: web.Request) -> bool:
    """Whether a browser says that a page of another site, or of another port, makes a request."""
    return request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")


def _is_viewer(request: web.Request, *methods: str) -> bool:
    """Whether a site for recordings reads one. It gets no cookie: where people log in, it is refused."""
    return (
        request.headers.get("Origin") in VIEWERS
        and VIEWED.fullmatch(request.path) is not None
        and request.method in (methods or ("GET", "HEAD", "OPTIONS"))
    )


def _failure(error: AiraError) -> web.Response:
    facts = {"code": error.code, "message": public_text(error), "hint": public_text(error.hint)}
    if isinstance(reason := getattr(error, "reason", None), str) and reason:
        facts["reason"] = reason
    return answer({"error": facts}, status=status_of(error))


@asynccontextmanager
async def served(
    settings: Settings, *, port: int, chain: Chain | None = None, agent: Agent | None = None
) -> AsyncIterator[str]:
    """See `mesh.dev.page.ServePage`."""
    async with (
        opened(settings, agent=agent, chain=chain) as components,
        PageServer(components, WebOptions(port=port)) as server,
    ):
        yield server.url

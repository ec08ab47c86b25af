"""JSON-RPC over HTTP in front of a provider, so that several processes share one embedded chain."""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING, Any, Final, cast

from aiohttp import web

from mesh.chain.jsonrpc import INTERNAL_ERROR, INVALID_PARAMS, INVALID_REQUEST, PARSE_ERROR, RpcError
from mesh.errors import AiraError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from types import TracebackType
    from typing import Self

    from web3.providers.async_base import AsyncBaseProvider
    from web3.types import RPCEndpoint

log = logging.getLogger(__name__)

MAX_BODY_BYTES: Final = 4 * 1024 * 1024
MAX_BATCH: Final = 1000
LOOPBACK_NAMES: Final = frozenset({"127.0.0.1", "localhost", "[::1]", "::1"})


class JsonRpcServer:
    """Serves `provider` (any whose results are JSON, as the embedded chain's and web3's HTTP provider's are).

    It listens on loopback unless told otherwise. A browser's page may call it only from one of `allowed_origins`
    (`"*"` for any); a loopback server also refuses requests that name another host, as a rebound DNS name would.

    Used with `async with`; leaving it finishes the requests under way. Entering raises `ConfigurationError` when the
    port is taken.
    """

    def __init__(
        self,
        provider: AsyncBaseProvider,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_origins: Iterable[str] = (),
    ) -> None:
        self._provider = provider
        self._host = host
        self._port = port
        self._origins = frozenset(allowed_origins)
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        """Where it listens, with the port that was really taken."""
        return f"http://{self._host}:{self._port}"

    async def __aenter__(self) -> Self:
        app = web.Application(client_max_size=MAX_BODY_BYTES)
        app.router.add_post("/", self._post)
        app.router.add_options("/", self._preflight)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, self._host, self._port).start()
        except OSError as error:
            await self._runner.cleanup()
            raise ConfigurationError(
                f"can't listen on {self._host}:{self._port}: {error.strerror}",
                hint="another node may run there; choose another port",
            ) from None
        self._port = self._runner.addresses[0][1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    async def _post(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        try:
            body = json.loads(await request.read())
        except ValueError:
            return _reply(_failure(None, PARSE_ERROR, "the body is not JSON"), headers)
        if not isinstance(body, list):
            return _reply(await self._answer(body), headers)
        if not 0 < len(body) <= MAX_BATCH:
            return _reply(_failure(None, INVALID_REQUEST, f"a batch holds 1 to {MAX_BATCH} requests"), headers)
        answers = [answer for one in body if (answer := await self._answer(one)) is not None]
        return _reply(answers or None, headers)

    async def _preflight(self, request: web.Request) -> web.Response:
        headers = self._admit(request)
        return web.Response(
            status=204,
            headers=headers | {"Access-Control-Allow-Methods": "POST", "Access-Control-Allow-Headers": "content-type"},
        )

    def _admit(self, request: web.Request) -> dict[str, str]:
        """The headers that let a page read the answer. Raises HTTP 403 for a page that may not ask."""
        name = (request.host or "").rpartition(":")[0] or request.host
        if self._host in LOOPBACK_NAMES and name not in LOOPBACK_NAMES:
            raise web.HTTPForbidden(text="this node serves its own machine only")
        origin = request.headers.get("Origin")
        if origin is None:
            return {}
        if origin not in self._origins and "*" not in self._origins:
            raise web.HTTPForbidden(text="pages of this origin may not ask this node")
        return {"Access-Control-Allow-Origin": origin, "Vary": "Origin"}

    async def _answer(self, request: Any) -> dict[str, Any] | None:
        """The response to one request; None for a notification, which gets none."""
        if not isinstance(request, dict) or not isinstance(request.get("method"), str):
            return _failure(None, INVALID_REQUEST, "a request is an object with jsonrpc, id, method and params")
        id_, params = request.get("id"), request.get("params", [])
        if not isinstance(params, list):
            return _failure(id_, INVALID_PARAMS, "params are a list")
        answer = await self._ask(request["method"], params, id_)
        return answer if "id" in request else None

    async def _ask(self, method: str, params: list[Any], id_: Any) -> dict[str, Any]:
        try:
            response = cast("dict[str, Any]", await self._provider.make_request(cast("RPCEndpoint", method), params))
        except RpcError as error:
            return _failure(id_, error.code, error.message)
        except AiraError as error:
            return _failure(id_, INTERNAL_ERROR, str(error))
        except Exception:
            log.exception("%s failed", method)
            return _failure(id_, INTERNAL_ERROR, f"{method} failed")
        member = "error" if "error" in response else "result"
        return {"jsonrpc": "2.0", "id": id_, member: response.get(member)}


def _failure(id_: Any, code: int, message: str) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": id_, "error": {"code": code, "message": message}}


def _reply(answer: Any, headers: dict[str, str]) -> web.Response:
    if answer is None:
        return web.Response(status=204, headers=headers)
    return web.json_response(answer, headers=headers)

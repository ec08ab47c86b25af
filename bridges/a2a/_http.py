"""The door over HTTP: who may use it, how much they may send, and the application that is served."""

from __future__ import annotations

import hmac
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from a2a.server.request_handlers.response_helpers import build_error_response
from a2a.server.routes import create_jsonrpc_routes, create_rest_routes
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from a2a.utils.errors import ContentTypeNotSupportedError
from google.protobuf.json_format import MessageToDict
from starlette.applications import Starlette
from starlette.responses import JSONResponse
from starlette.routing import Route

from bridges.a2a._card import KEYS_PATH
from bridges.web.access import ServerOptions, require_loopback
from mesh.errors import ConfigurationError
from mesh.signer.protocol import LARGEST_REQUEST

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, MutableMapping

    from starlette.requests import Request
    from starlette.responses import Response

    from bridges.a2a._card import Card, CardKey
    from bridges.a2a._door import A2aDoor

    Message = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[Message]]
    Send = Callable[[Message], Awaitable[None]]

PUBLIC: Final = frozenset({AGENT_CARD_WELL_KNOWN_PATH, KEYS_PATH})
"""The paths that anybody may read."""


@dataclass(frozen=True, kw_only=True)
class A2aOptions(ServerOptions):
    """Where the door listens; the holders of `token` may use it."""

    def check(self) -> None:
        """Raise `ConfigurationError` for a server that other machines can reach without TLS, or one without a login."""
        if not self.token:
            raise ConfigurationError("the door needs a token", hint="give --token-file", code="token-too-short")
        if not (self.certificate and self.key):
            require_loopback(self.host, "--certificate and --key")


def application(door: A2aDoor, card: Callable[[], Card], key: CardKey, token: str) -> Any:
    """The ASGI application of the door."""

    async def keys(request: Request) -> Response:
        return JSONResponse(key.published())

    async def served(request: Request) -> Response:
        return JSONResponse(MessageToDict(await card().get()), headers={"Cache-Control": "public, max-age=60"})

    routes = [
        Route(AGENT_CARD_WELL_KNOWN_PATH, served, methods=["GET"]),
        Route(KEYS_PATH, keys, methods=["GET"]),
        *create_jsonrpc_routes(door, "/"),
        *create_rest_routes(door, path_prefix="/rest"),
    ]
    return Guarded(Starlette(routes=routes), token)


class Guarded:
    """Lets the holders of the token in, compared in constant time, with bodies of up to `LARGEST_REQUEST` bytes."""

    def __init__(self, app: Any, token: str) -> None:
        self._app = app
        self._token = f"Bearer {token}".encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Serve one request, or the lifespan."""
        if scope["type"] != "http" or (scope["path"] in PUBLIC and scope["method"] in ("GET", "HEAD")):
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        scheme, _, given = headers.get(b"authorization", b"").partition(b" ")
        if not hmac.compare_digest(scheme.title() + b" " + given.strip(), self._token):
            await _refuse(send, 401, "a token is needed: Authorization: Bearer …", (b"www-authenticate", b"Bearer"))
            return
        length = headers.get(b"content-length", b"0")
        if not length.isdigit() or len(length) > 12 or int(length) > LARGEST_REQUEST:
            await _refuse(send, 413, f"a request has at most {LARGEST_REQUEST} bytes", (b"connection", b"close"))
            return
        if scope["path"] == "/" and not headers.get(b"content-type", b"").lower().startswith(b"application/json"):
            await _answer(send, 200, build_error_response(None, ContentTypeNotSupportedError("send application/json")))
            return
        arrived = 0

        async def bounded() -> Message:
            nonlocal arrived
            message = await receive()
            arrived += len(message.get("body", b""))
            return {"type": "http.disconnect"} if arrived > LARGEST_REQUEST else message

        await self._app(scope, bounded, send)


async def _refuse(send: Send, status: int, text: str, header: tuple[bytes, bytes]) -> None:
    await _answer(send, status, {"error": {"code": status, "message": text}}, header)


async def _answer(send: Send, status: int, answer: dict[str, Any], *more: tuple[bytes, bytes]) -> None:
    body = json.dumps(answer).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()), *more]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})

"""The door over HTTP: the application that is served."""

from __future__ import annotations

from typing import TYPE_CHECKING

from a2a.server.request_handlers.response_helpers import build_error_response
from a2a.server.routes import create_jsonrpc_routes, create_rest_routes
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from a2a.utils.errors import ContentTypeNotSupportedError
from google.protobuf.json_format import MessageToDict
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.routing import Route

from bridges.a2a._card import KEYS_PATH
from bridges.serving import guarded

if TYPE_CHECKING:
    from a2a.server.request_handlers import RequestHandler
    from starlette.requests import Request
    from starlette.responses import Response

    from bridges.a2a._card import Card, CardKey
    from bridges.serving import DoorOptions
    from mesh.base.asgi_server import AsgiApplication, Message, Receive, Send


def application(door: RequestHandler, card: Card, key: CardKey, options: DoorOptions) -> AsgiApplication:
    """The ASGI application of a door."""

    async def keys(request: Request) -> Response:
        return JSONResponse(key.published())

    async def served(request: Request) -> Response:
        return JSONResponse(MessageToDict(await card.get()), headers={"Cache-Control": "public, max-age=60"})

    routes = Starlette(
        routes=[
            Route(AGENT_CARD_WELL_KNOWN_PATH, served, methods=["GET"]),
            Route(KEYS_PATH, keys, methods=["GET"]),
            *create_jsonrpc_routes(door, "/"),
            *create_rest_routes(door, path_prefix="/rest"),
        ]
    )

    async def typed(scope: Message, receive: Receive, send: Send) -> None:
        kind = Headers(scope=scope).get("content-type", "") if scope["type"] == "http" else ""
        if scope["type"] == "http" and scope["path"] == "/" and not kind.lower().startswith("application/json"):
            refusal = build_error_response(None, ContentTypeNotSupportedError("send application/json"))
            await JSONResponse(refusal)(scope, receive, send)
        else:
            await routes(scope, receive, send)

    return guarded(typed, options, public=(AGENT_CARD_WELL_KNOWN_PATH, KEYS_PATH))

"""JSON-RPC requests, single or in batches, answered by a provider."""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from mesh.devchain.jsonrpc import INTERNAL_ERROR, INVALID_PARAMS, INVALID_REQUEST, PARSE_ERROR, RpcError
from mesh.errors import AiraError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from web3.providers.async_base import AsyncBaseProvider
    from web3.types import RPCEndpoint

log = logging.getLogger(__name__)

MAX_BATCH: Final = 1000

Method: TypeAlias = "Callable[[list[Any]], Awaitable[Any]]"
"""A method that a connection has beside the provider's. Raises `RpcError`."""


class Dispatcher:
    """Answers whatever text comes in front of a provider, always with JSON-RPC."""

    def __init__(self, provider: AsyncBaseProvider) -> None:
        self._provider = provider

    async def respond(self, text: str | bytes, *, methods: Mapping[str, Method] | None = None) -> Any:
        """The response to a request or a batch; None where there is none to give, as to notifications.

        `methods` are those of the connection that it came on.
        """
        try:
            body = json.loads(text)
        except (ValueError, RecursionError):
            return _failure(None, PARSE_ERROR, "the body is not JSON")
        if not isinstance(body, list):
            return await self._answer(body, methods or {})
        if not 0 < len(body) <= MAX_BATCH:
            return _failure(None, INVALID_REQUEST, f"a batch holds 1 to {MAX_BATCH} requests")
        answers = [answer for one in body if (answer := await self._answer(one, methods or {})) is not None]
        return answers or None

    async def ask(self, method: str, params: list[Any]) -> Any:
        """The result of a method of the provider. Raises `RpcError`, and what the provider raises."""
        response = cast("dict[str, Any]", await self._provider.make_request(cast("RPCEndpoint", method), params))
        if "error" in response:
            error = response["error"]
            raise RpcError(int(error["code"]), str(error["message"]), data=error.get("data"))
        return response.get("result")

    async def _answer(self, request: Any, methods: Mapping[str, Method]) -> dict[str, Any] | None:
        """The response to one request; None for a notification, which gets none."""
        if not isinstance(request, dict) or not isinstance(request.get("method"), str):
            return _failure(None, INVALID_REQUEST, "a request is an object with jsonrpc, id, method and params")
        id_, params = request.get("id"), request.get("params", [])
        if not isinstance(params, list):
            return _failure(id_, INVALID_PARAMS, "params are a list")
        answer = await self._call(request["method"], params, id_, methods)
        return answer if "id" in request else None

    async def _call(self, method: str, params: list[Any], id_: Any, methods: Mapping[str, Method]) -> dict[str, Any]:
        try:
            result = await (methods[method](params) if method in methods else self.ask(method, params))
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": id_, "error": error.as_object()}
        except AiraError as error:
            return _failure(id_, INTERNAL_ERROR, str(error))
        except Exception:
            log.exception("%s failed", method)
            return _failure(id_, INTERNAL_ERROR, f"{method} failed")
        return {"jsonrpc": "2.0", "id": id_, "result": result}


def _failure(id_: Any, code: int, message: str) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": id_, "error": {"code": code, "message": message}}

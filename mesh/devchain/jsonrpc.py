"""JSON-RPC 2.0 as Ethereum nodes speak it: quantities, data, errors, requests and batches.

Quantities are hexadecimal without leading zeros (`0x0`, `0x1f`), data is hexadecimal with two digits a byte
(`0x`, `0x01ff`); both as in the execution API specification.
"""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from mesh.errors import AiraError
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from mesh.chain.transports import Transport

log = logging.getLogger(__name__)

PARSE_ERROR: Final = -32700
INVALID_REQUEST: Final = -32600

INVALID_PARAMS: Final = -32602
INTERNAL_ERROR: Final = -32603
SERVER_ERROR: Final = -32000
RESPONSE_TOO_LARGE: Final = -32003
LIMIT_EXCEEDED: Final = -32005

MAX_BATCH: Final = 1_000
"""Requests in a batch."""
MAX_QUANTITY: Final = 2**256 - 1
MAX_RESPONSE_BYTES: Final = 25_000_000
"""The answers to a batch; the requests that come after are refused."""
INLINE_BYTES: Final = 50_000
"""Requests up to this size are parsed on the event loop; larger ones, and all answers, in a thread."""

CHANGES: Final = frozenset({"eth_sendRawTransaction", "eth_sendTransaction", "evm_mine", "evm_revert"})
"""The methods that change the chain: one after another."""
RUNS: Final = frozenset({"eth_call", "eth_estimateGas"})
"""The methods that run contracts, which takes time, and change nothing: several at once."""

Method: TypeAlias = "Callable[[list[Any]], Awaitable[Any]]"
"""A method that a connection has in addition to the provider's. Raises `RpcError`."""


class RpcError(Exception):
    """An error that goes to the caller of the JSON-RPC method, not to ours."""

    def __init__(self, code: int, message: str, *, data: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.data = data

    def as_object(self) -> dict[str, Any]:
        """The `error` member of a response."""
        error: dict[str, Any] = {"code": self.code, "message": self.message}
        if self.data is not None:
            error["data"] = self.data
        return error


def parse_quantity(value: object) -> int:
    """A quantity of the parameters as an int. Raises `RpcError` (invalid params)."""
    number = -1
    if isinstance(value, int) and not isinstance(value, bool):
        number = value
    elif isinstance(value, str) and value.startswith("0x"):
        with suppress(ValueError):
            number = int(value, 16)
    if 0 <= number <= MAX_QUANTITY:
        return number
    raise RpcError(INVALID_PARAMS, f"{str(value)[:80]!r} is not a quantity (0x…)")


def parse_data(value: object, *, length: int | None = None) -> bytes:
    """Data of the parameters as bytes, of `length` bytes where given. Raises `RpcError` (invalid params)."""
    data: bytes | None = None
    if isinstance(value, bytes):
        data = bytes(value)
    elif isinstance(value, str) and value.startswith("0x"):
        try:
            data = bytes.fromhex(value[2:])
        except ValueError:
            data = None
    if data is None or (length is not None and len(data) != length):
        size = "" if length is None else f" of {length} bytes"
        raise RpcError(INVALID_PARAMS, f"{str(value)[:80]!r} is not data{size} (0x…)")
    return data


def to_json(value: Any) -> Any:
    """A value of the node as JSON-RPC has it: ints as quantities, bytes as data, keys in camel case."""
    match value:
        case None | bool() | str():
            return value
        case int():
            return hex(value)
        case bytes():
            return "0x" + value.hex()
        case dict():
            return {camel(name): to_json(member) for name, member in value.items()}
        case list() | tuple():
            return [to_json(member) for member in value]
    raise TypeError(f"no JSON-RPC form of {type(value).__name__}")


def camel(name: str) -> str:
    """`block_number` → `blockNumber`."""
    head, *rest = name.split("_")
    return head + "".join(part.capitalize() for part in rest)


class Dispatcher:
    """Answers JSON-RPC requests with the results of a provider; any other text with a JSON-RPC error."""

    def __init__(self, provider: Transport, *, max_response_bytes: int = MAX_RESPONSE_BYTES) -> None:
        self._provider = provider
        self._max_response_bytes = max_response_bytes

    async def respond(self, text: str | bytes, *, methods: Mapping[str, Method] | None = None) -> str | None:
        """The response to a request or a batch, as JSON; None for notifications, which get none.

        `methods` are those of the connection it came on.
        """
        try:
            body = json.loads(text) if len(text) < INLINE_BYTES else await asyncio.to_thread(json.loads, text)
        except (ValueError, RecursionError):
            return json.dumps(_failure(None, PARSE_ERROR, "the body is not JSON"))
        if not isinstance(body, list):
            return await self._answer(body, methods or {})
        if not 0 < len(body) <= MAX_BATCH:
            return json.dumps(_failure(None, INVALID_REQUEST, f"a batch holds 1 to {MAX_BATCH} requests"))
        answers: list[str] = []
        size = 0
        for request in body:
            if size > self._max_response_bytes:
                id_ = request.get("id") if isinstance(request, dict) else None
                answer: str | None = json.dumps(_failure(id_, RESPONSE_TOO_LARGE, "response too large"))
            else:
                answer = await self._answer(request, methods or {})
            if answer is not None:
                answers.append(answer)
                size += len(answer)
        return f"[{','.join(answers)}]" if answers else None

    async def ask(self, method: str, params: list[Any]) -> Any:
        """The result of a method of the provider. Raises `RpcError`, and what the provider raises."""
        response = cast("dict[str, Any]", await self._provider.make_request(method, params))
        if "error" in response:
            error = response["error"]
            raise RpcError(int(error["code"]), str(error["message"]), data=error.get("data"))
        return response.get("result")

    async def _answer(self, request: Any, methods: Mapping[str, Method]) -> str | None:
        """The response to one request; None for a notification, which gets none."""
        if not isinstance(request, dict) or not isinstance(request.get("method"), str):
            return json.dumps(
                _failure(None, INVALID_REQUEST, "a request is an object with jsonrpc, id, method and params")
            )
        id_, params = request.get("id"), request.get("params", [])
        if not isinstance(params, list):
            return json.dumps(_failure(id_, INVALID_PARAMS, "params are a list"))
        answer = await self._call(request["method"], params, id_, methods)
        return await asyncio.to_thread(json.dumps, answer) if "id" in request else None

    async def _call(self, method: str, params: list[Any], id_: Any, methods: Mapping[str, Method]) -> dict[str, Any]:
        try:
            result = await (methods[method](params) if method in methods else self.ask(method, params))
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": id_, "error": error.as_object()}
        except AiraError as error:
            return _failure(id_, INTERNAL_ERROR, str(error))
        except Exception:
            log.exception("%s failed", method, extra=log_event("rpc-method-failed", method=method))
            return _failure(id_, INTERNAL_ERROR, f"{method} failed")
        return {"jsonrpc": "2.0", "id": id_, "result": result}


def _failure(id_: Any, code: int, message: str) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": id_, "error": {"code": code, "message": message}}

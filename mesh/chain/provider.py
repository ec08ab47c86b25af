"""The way to a node: one provider that retries what may be retried, and speaks our errors.

Everything above it (web3's modules and contracts) then raises `NodeUnreachable`, `Reverted` or `RequestRefused`
by itself.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from aiohttp import ClientError, ClientResponseError
from web3.exceptions import Web3Exception
from web3.providers.async_base import AsyncBaseProvider

from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.chain.reverts import decode_revert
from mesh.chain.transports import HttpTransport, WebSocketTransport
from mesh.errors import AiraError, ClosedError, ConfigurationError

if TYPE_CHECKING:
    from web3.types import RPCEndpoint, RPCResponse

    from mesh.chain.timing import Timing

log = logging.getLogger(__name__)

CONNECTION_ERRORS: Final = (OSError, TimeoutError, ClientError, Web3Exception, ValueError)
"""What transports raise when there is no node, no connection any more, or no JSON in the answer."""

Transport: TypeAlias = HttpTransport | WebSocketTransport

SEND: Final = "eth_sendRawTransaction"
TRANSIENT_STATUS: Final = frozenset({429, 500, 502, 503, 504})


class ReliableProvider(AsyncBaseProvider):
    """A provider in front of another, with bounded retries.

    A request is repeated when the connection fails, `timing.attempts` times in all with a growing delay; only a
    transaction goes out once, as its sender has to know whether an earlier attempt may have arrived. `owned` is the
    transport that `close` closes.
    """

    def __init__(
        self, inner: AsyncBaseProvider, *, endpoint: str, timing: Timing, owned: Transport | None = None
    ) -> None:
        super().__init__()
        self.endpoint = endpoint
        self._inner = inner
        self._owned = owned
        self._timing = timing
        self._is_open = False

    def open(self) -> None:
        """Let requests through, until `close`."""
        self._is_open = True

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        """The node's response, which holds a result.

        Raises `NodeUnreachable` after the last attempt, `Reverted`, `RequestRefused`, `ClosedError`.
        """
        if not self._is_open:
            raise ClosedError("the connection to the node is not open: use it with `async with`")
        attempts = 1 if method == SEND else self._timing.attempts
        delay = self._timing.retry_delay
        for attempt in range(1, attempts + 1):
            try:
                async with asyncio.timeout(self._timing.request_timeout):
                    response = await self._inner.make_request(method, params)
                break
            except AiraError:
                raise
            except CONNECTION_ERRORS as error:
                if attempt == attempts or not _is_transient(error):
                    raise NodeUnreachable(self.endpoint, _why(error)) from error
                log.debug("%s: %s failed (%s); trying again in %.2f s", self.endpoint, method, _why(error), delay)
            await asyncio.sleep(delay)
            delay *= 2
        return self._checked(method, response)

    async def is_connected(self, show_traceback: bool = False) -> bool:
        """Whether the node answers."""
        try:
            await self._inner.make_request("web3_clientVersion", [])  # type: ignore[arg-type]
        except (AiraError, *CONNECTION_ERRORS):
            return False
        return True

    async def close(self) -> None:
        """Close the connection, if this side opened it; further requests raise `ClosedError`."""
        self._is_open = False
        if self._owned is not None:
            await self._owned.close()

    def _checked(self, method: str, response: Any) -> RPCResponse:
        """The response, unless it is an error or nothing that a node would say."""
        if not isinstance(response, dict) or ("result" not in response and "error" not in response):
            raise NodeUnreachable(self.endpoint, "what answers is not a JSON-RPC server")
        error = response.get("error")
        if error is None:
            return response  # type: ignore[return-value]
        if not isinstance(error, dict):
            raise RequestRefused(method, 0, str(error))
        reverted = decode_revert(error)
        if reverted is not None:
            raise reverted
        raise RequestRefused(method, int(error.get("code", 0)), str(error.get("message", "")))


def open_provider(endpoint: str | AsyncBaseProvider, timing: Timing) -> ReliableProvider:
    """The provider of an endpoint: `http(s)://…`, `ws(s)://…`, or a provider object.

    Nothing is connected yet. Raises `ConfigurationError` for any other text.
    """
    if not isinstance(endpoint, str):
        return ReliableProvider(endpoint, endpoint=str(endpoint), timing=timing)
    transport: Transport
    if endpoint.startswith(("http://", "https://")):
        transport = HttpTransport(endpoint)
    elif endpoint.startswith(("ws://", "wss://")):
        transport = WebSocketTransport(endpoint)
    else:
        raise ConfigurationError(
            f"{endpoint!r} is not the address of a node",
            hint="an address begins with http://, https://, ws:// or wss://",
        )
    return ReliableProvider(transport, endpoint=endpoint, timing=timing, owned=transport)


def _is_transient(error: Exception) -> bool:
    if isinstance(error, ClientResponseError):
        return error.status in TRANSIENT_STATUS
    return not isinstance(error, ValueError)


def _why(error: Exception) -> str:
    match error:
        case ClientResponseError():
            return f"HTTP {error.status} {error.message}"
        case TimeoutError():
            return "no answer in time"
        case OSError() if error.strerror:
            return error.strerror
        case ValueError():
            return "the answer is not JSON"
    return str(error) or type(error).__name__

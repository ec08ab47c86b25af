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

from mesh.chain.errors import NodeUnreachable, RequestRefused, WrongChain
from mesh.chain.node_metrics import NodeMetrics
from mesh.chain.reverts import decode_revert
from mesh.chain.transports import HttpTransport, WebSocketTransport
from mesh.errors import AiraError, ClosedError, ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from web3.types import RPCEndpoint, RPCResponse

    from mesh.chain.timing import Timing

log = logging.getLogger(__name__)

CONNECTION_ERRORS: Final = (OSError, TimeoutError, ClientError, Web3Exception, ValueError)
"""What transports raise when there is no node, no connection any more, or no JSON in the answer."""

Transport: TypeAlias = HttpTransport | WebSocketTransport
Endpoint: TypeAlias = "str | Sequence[str] | AsyncBaseProvider"

SEND: Final = "eth_sendRawTransaction"
TRANSIENT_STATUS: Final = frozenset({429, 500, 502, 503, 504})

CHECK_TIMEOUT: Final = 2.0
"""Seconds that opening waits for the nodes beside the one in use, to say which chain they are on."""


class NotJsonRpc(ValueError):
    """What answers is no JSON-RPC server, or none of this chain."""


class Upstream:
    """One of the nodes that requests can go to. `owned` is the transport that is closed with the provider."""

    def __init__(self, provider: AsyncBaseProvider, *, endpoint: str, owned: Transport | None = None) -> None:
        self.endpoint = endpoint
        self.provider = provider
        self.owned = owned
        self.is_on_chain = False
        """Whether it was seen to be on the chain of the others."""


class ReliableProvider(AsyncBaseProvider):
    """A provider in front of one or several others, with bounded retries.

    A request goes to the node that answered last; when its connection fails, to the next, and so on around all of
    them, `timing.attempts` times with a growing delay in between. Only a transaction goes to one node once, as its
    sender has to know whether an earlier attempt may have arrived; the sender's next attempt goes to the next node.
    A node that is on another chain than the first that answered is an error at the opening, where it answers soon, and
    passed over later.
    """

    def __init__(self, ways: Sequence[Upstream], *, timing: Timing, tally: NodeMetrics) -> None:
        super().__init__()
        self.endpoint = ", ".join(way.endpoint for way in ways)
        self._ways = tuple(ways)
        self._timing = timing
        self._tally = tally
        self._chain_id: object = None
        self._is_open = False

    def open(self) -> None:
        """Let requests through, until `close`."""
        self._is_open = True

    async def check_chains(self, expected: int) -> None:
        """Look which chain the nodes are on that answer within `CHECK_TIMEOUT`. Raises `WrongChain`."""
        if len(self._ways) == 1:
            return
        found = await asyncio.gather(*(self._chain_of(way) for way in self._ways))
        for way, chain_id in zip(self._ways, found, strict=True):
            if chain_id is None:
                log.warning("the node %s does not answer now; it is asked when another fails", way.endpoint)
            elif chain_id != expected:
                raise WrongChain(way.endpoint, found=chain_id, expected=expected)

    async def _chain_of(self, way: Upstream) -> int | None:
        """The number of the chain that a node is on; None if it does not say."""
        try:
            async with asyncio.timeout(CHECK_TIMEOUT):
                response: Any = await way.provider.make_request("eth_chainId", [])  # type: ignore[arg-type]
                return int(response["result"], 16)
        except (*CONNECTION_ERRORS, LookupError, TypeError):
            return None

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        """The node's response, which holds a result.

        Raises `NodeUnreachable` after the last attempt, `Reverted`, `RequestRefused`, `ClosedError`.
        """
        if not self._is_open:
            raise ClosedError("the connection to the node is not open: use it with `async with`")
        attempts = 1 if method == SEND else self._timing.attempts
        delay = self._timing.retry_delay
        for attempt in range(1, attempts + 1):
            failures: list[Exception] = []
            for way in self._ways[:1] if method == SEND else self._ways:
                try:
                    answer = await self._ask(way, method, params)
                    self._tally.answered()
                    return _checked(method, answer)
                except AiraError:
                    raise
                except CONNECTION_ERRORS as error:
                    failures.append(error)
                    self._turn_from(way, _why(error))
                    why = _why(error) if len(self._ways) == 1 else f"{way.endpoint}: {_why(error)}"
            if attempt == attempts or not any(_is_transient(failure) for failure in failures):
                break
            log.debug("%s failed (%s); trying again in %.2f s", method, why, delay)
            await asyncio.sleep(delay)
            delay *= 2
        self._tally.failed()
        raise NodeUnreachable(self.endpoint, why) from failures[-1]

    async def _ask(self, way: Upstream, method: RPCEndpoint, params: Any) -> dict[str, Any]:
        """What a node answers. Raises `CONNECTION_ERRORS`."""
        async with asyncio.timeout(self._timing.request_timeout):
            if not way.is_on_chain and len(self._ways) > 1:
                await self._check_chain(way)
            response: Any = await way.provider.make_request(method, params)
        if not isinstance(response, dict) or ("result" not in response and "error" not in response):
            raise NotJsonRpc("what answers is not a JSON-RPC server")
        return response

    async def _check_chain(self, way: Upstream) -> None:
        response: Any = await way.provider.make_request("eth_chainId", [])  # type: ignore[arg-type]
        found = response.get("result") if isinstance(response, dict) else None
        if self._chain_id is None:
            self._chain_id = found
        if found is None or found != self._chain_id:
            raise NotJsonRpc(f"it is on the chain {found}, the others are on {self._chain_id}")
        way.is_on_chain = True

    def _turn_from(self, way: Upstream, why: str) -> None:
        """Ask another node first from now on; the one that failed comes last."""
        way.is_on_chain = False  # it may come back as another
        if len(self._ways) > 1 and self._ways[0] is way:
            self._ways = (*self._ways[1:], way)
            log.warning("the node %s fails (%s); turning to %s", way.endpoint, why, self._ways[0].endpoint)

    async def is_connected(self, show_traceback: bool = False) -> bool:
        """Whether a node answers."""
        try:
            await self.make_request("web3_clientVersion", [])  # type: ignore[arg-type]
        except AiraError:
            return False
        return True

    async def close(self) -> None:
        """Close the connections that this side opened; further requests raise `ClosedError`."""
        self._is_open = False
        for way in self._ways:
            if way.owned is not None:
                await way.owned.close()


def open_provider(endpoint: Endpoint, timing: Timing, tally: NodeMetrics | None = None) -> ReliableProvider:
    """The provider of an endpoint: `http(s)://…`, `ws(s)://…`, several of them, or a provider object.

    Several are a sequence, or one text with commas. Nothing is connected yet. `tally` counts whether they answer.
    Raises `ConfigurationError` for any other text.
    """
    tally = tally or NodeMetrics()
    if isinstance(endpoint, AsyncBaseProvider):
        return ReliableProvider([Upstream(endpoint, endpoint=str(endpoint))], timing=timing, tally=tally)
    texts = [endpoint] if isinstance(endpoint, str) else endpoint
    urls = [url.strip() for text in texts for url in text.split(",")] or [""]
    return ReliableProvider([_way(url) for url in urls], timing=timing, tally=tally)


def _way(url: str) -> Upstream:
    transport: Transport
    if url.startswith(("http://", "https://")):
        transport = HttpTransport(url)
    elif url.startswith(("ws://", "wss://")):
        transport = WebSocketTransport(url)
    else:
        raise ConfigurationError(
            f"{url!r} is not the address of a node",
            hint="an address begins with http://, https://, ws:// or wss://; several are separated by commas",
        )
    return Upstream(transport, endpoint=url, owned=transport)


def _checked(method: str, response: dict[str, Any]) -> RPCResponse:
    """The response, unless it is an error."""
    error = response.get("error")
    if error is None:
        return response  # type: ignore[return-value]
    if not isinstance(error, dict):
        raise RequestRefused(method, 0, str(error))
    reverted = decode_revert(error)
    if reverted is not None:
        raise reverted
    raise RequestRefused(method, int(error.get("code", 0)), str(error.get("message", "")))


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
        case ValueError() if not isinstance(error, NotJsonRpc):
            return "the answer is not JSON"
    return str(error) or type(error).__name__

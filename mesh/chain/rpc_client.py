"""Requests to one or several nodes, with retries. Every answer is checked here, before anything uses it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from aiohttp import ClientError, ClientResponseError
from aiohttp.http import HttpProcessingError

from mesh.chain.answers import ANSWERS, BlockHeader, RpcFailure, SpoiledAnswer, decode_answer
from mesh.chain.errors import InvalidEndpoint, NodeUnreachable, RequestRefused, WrongChain
from mesh.chain.metrics import NodeMetrics
from mesh.chain.reverts import decode_revert
from mesh.chain.transports import HttpTransport, Transport, WebSocketTransport
from mesh.errors import AiraError, ClosedError
from mesh.log_context import log_event
from mesh.retry import Backoff

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.chain.policy import Timing

log = logging.getLogger(__name__)

CONNECTION_ERRORS: Final = (OSError, TimeoutError, ClientError, ValueError)
"""What transports raise for a missing node, a lost connection and an answer that is not JSON; and `SpoiledAnswer`."""

Connection: TypeAlias = HttpTransport | WebSocketTransport
Endpoint: TypeAlias = "str | Transport | Sequence[str | Transport]"

SEND: Final = "eth_sendRawTransaction"
CHAIN_ID: Final = "eth_chainId"
NEW_HEADS: Final = "newHeads"
TRANSIENT_STATUS: Final = frozenset({429, 500, 502, 503, 504})

CHECK_TIMEOUT: Final = 2.0
"""Seconds that opening waits for the other nodes to say which chain they are on."""


class NotJsonRpc(ValueError):
    """The server does not speak JSON-RPC, or is a node of another chain."""


class Upstream:
    """One of the nodes. `owned` is its connection, if that is closed with the client."""

    def __init__(self, transport: Transport, *, endpoint: str, owned: Connection | None = None) -> None:
        self.endpoint = endpoint
        self.transport = transport
        self.owned = owned
        self.is_on_chain = False
        """Whether it said that it is on the chain of the others."""
        self.is_node = False
        """Whether it has answered as a node does, so that it is one although it may fail to do so at times."""


class RpcClient:
    """One or several nodes, with bounded retries.

    A request goes to the node that answered last; if its connection fails or its answer is spoiled, to the next, and
    so on around all of them, again and again by `Timing.request_retry`. Only a transaction goes to one node once,
    because its sender must know whether an earlier attempt may have arrived; the sender's next attempt goes to the
    next node. A node on another chain than the first that answered is an error when opening, if it answers soon, and
    skipped later.
    """

    def __init__(self, upstreams: Sequence[Upstream], *, timing: Timing, metrics: NodeMetrics) -> None:
        self.endpoint = ", ".join(upstream.endpoint for upstream in upstreams)
        self._upstreams = tuple(upstreams)
        self._timing = timing
        self._metrics = metrics
        self._expected: int | RpcFailure | None = None
        self._is_open = False
        self._on_head: Callable[[BlockHeader | None], None] | None = None

    def open(self) -> None:
        """Let requests through, until `close`."""
        self._is_open = True

    def push_heads(self, on_head: Callable[[BlockHeader | None], None]) -> None:
        """Call `on_head` with each new block that the node in use pushes, and with None when it no longer does.

        Only over WebSocket, and only of the node that requests go to. May be called again and again.
        """
        self._on_head = on_head
        first = self._upstreams[0]
        if isinstance(first.owned, WebSocketTransport):
            first.owned.push_heads(partial(self._take_head, first))

    def _take_head(self, upstream: Upstream, pushed: Any) -> None:
        if upstream is not self._upstreams[0] or self._on_head is None:
            return
        try:
            head = None if pushed is None else decode_answer(NEW_HEADS, {"result": pushed}, BlockHeader)
        except SpoiledAnswer as error:
            log.debug("%s: %s", upstream.endpoint, error)
        else:
            self._on_head(head)

    async def check_chains(self, expected: int) -> None:
        """Raise `WrongChain` if a node that answers within `CHECK_TIMEOUT` is on another chain."""
        if len(self._upstreams) == 1:
            return
        found = await asyncio.gather(*(self._chain_of(upstream) for upstream in self._upstreams))
        for upstream, chain_id in zip(self._upstreams, found, strict=True):
            if chain_id is None:
                log.warning(
                    "the node %s does not answer; it is asked when another fails",
                    upstream.endpoint,
                    extra=log_event("node-silent", node=upstream.endpoint),
                )
            elif chain_id != expected:
                raise WrongChain(upstream.endpoint, found=chain_id, expected=expected)

    async def _chain_of(self, upstream: Upstream) -> int | None:
        """The number of a node's chain; None if it does not answer."""
        try:
            async with asyncio.timeout(CHECK_TIMEOUT):
                found = await _chain_id(upstream)
        except CONNECTION_ERRORS:
            return None
        return found if isinstance(found, int) else None

    async def request(self, method: str, params: Any, *, kind: Any = Any) -> Any:
        """The node's result, of the type `kind` (see `mesh.chain.answers`).

        Raises `NodeUnreachable` after the last attempt, `Reverted`, `RequestRefused`, `ClosedError`.
        """
        if not self._is_open:
            raise ClosedError("the connection to the node is not open: use it with `async with`")
        backoff = Backoff(self._timing.request_retry)
        while True:
            may_pass = False
            for upstream in self._upstreams[:1] if method == SEND else self._upstreams:
                try:
                    answer = await self._ask(upstream, method, params, kind)
                    self._metrics.answered()
                    return _result(method, answer)
                except AiraError:
                    raise
                except CONNECTION_ERRORS as error:
                    failure = error
                    may_pass = may_pass or _may_pass(error, upstream)
                    reason = _reason(error)
                    self._demote(upstream, reason)
                    if len(self._upstreams) > 1:
                        reason = f"{upstream.endpoint}: {reason}"
            log.debug("%s failed (%s)", method, reason)
            if method == SEND or not may_pass or not await backoff.wait():
                break
        self._metrics.failed()
        raise NodeUnreachable(self.endpoint, reason) from failure

    async def _ask(self, upstream: Upstream, method: str, params: Any, kind: Any) -> Any:
        """What a node answers. Raises `CONNECTION_ERRORS`."""
        timing = self._timing
        most = timing.request_timeout if upstream.is_node else min(timing.first_timeout, timing.request_timeout)
        async with asyncio.timeout(most):
            if not upstream.is_on_chain and len(self._upstreams) > 1:
                await self._check_chain(upstream)
            return await _ask(upstream, method, params, kind)

    async def _check_chain(self, upstream: Upstream) -> None:
        found = await _chain_id(upstream)
        if self._expected is None:
            self._expected = found
        if found != self._expected:
            raise NotJsonRpc(f"it is on the chain {_shown(found)}, the others are on {_shown(self._expected)}")
        upstream.is_on_chain = True

    def _demote(self, upstream: Upstream, reason: str) -> None:
        """Ask another node first from now on, and the one that failed last."""
        upstream.is_on_chain = False  # it may come back as another
        if len(self._upstreams) > 1 and self._upstreams[0] is upstream:
            self._upstreams = (*self._upstreams[1:], upstream)
            if self._on_head is not None:
                self._on_head(None)
            log.warning(
                "the node %s fails (%s); switching to %s",
                upstream.endpoint,
                reason,
                self._upstreams[0].endpoint,
                extra=log_event(
                    "node-switched", failed=upstream.endpoint, reason=reason, next=self._upstreams[0].endpoint
                ),
            )

    async def close(self) -> None:
        """Close the connections that this side opened; further requests raise `ClosedError`."""
        self._is_open = False
        for upstream in self._upstreams:
            if upstream.owned is not None:
                await upstream.owned.close()


def rpc_client(endpoint: Endpoint, timing: Timing, metrics: NodeMetrics | None = None) -> RpcClient:
    """The client of an endpoint: `http(s)://…`, `ws(s)://…`, a `Transport`, or several of them.

    Several are a sequence, or one text with commas. Nothing is connected yet. `metrics` counts whether they answer.
    Raises `InvalidEndpoint` for any other text.
    """
    metrics = metrics or NodeMetrics()
    given = endpoint if isinstance(endpoint, Sequence) and not isinstance(endpoint, str) else [endpoint]
    upstreams: list[Upstream] = []
    for one in given or [""]:
        if isinstance(one, str):
            upstreams += [_upstream(url.strip()) for url in one.split(",")]
        else:
            upstreams.append(Upstream(one, endpoint=str(one)))
    return RpcClient(upstreams, timing=timing, metrics=metrics)


def _upstream(url: str) -> Upstream:
    transport: Connection
    if url.startswith(("http://", "https://")):
        transport = HttpTransport(url)
    elif url.startswith(("ws://", "wss://")):
        transport = WebSocketTransport(url)
    else:
        raise InvalidEndpoint(url)
    return Upstream(transport, endpoint=url, owned=transport)


async def _ask(upstream: Upstream, method: str, params: Any, kind: Any) -> Any:
    """The result or the `RpcFailure` of one request to one node. Raises `CONNECTION_ERRORS`."""
    response: Any = await upstream.transport.make_request(method, params)
    if not isinstance(response, dict) or not response.keys() & {"jsonrpc", "result", "error"}:
        raise NotJsonRpc("what answers is not a JSON-RPC server")
    answer = decode_answer(method, response, kind)
    upstream.is_node = True
    return answer


async def _chain_id(upstream: Upstream) -> int | RpcFailure:
    found: int | RpcFailure = await _ask(upstream, CHAIN_ID, [], ANSWERS[CHAIN_ID])
    return found


def _result(method: str, answer: Any) -> Any:
    """The answer, unless it is a failure. Raises `Reverted`, `RequestRefused`."""
    if not isinstance(answer, RpcFailure):
        return answer
    reverted = decode_revert(answer)
    raise reverted or RequestRefused(method, answer.code, answer.message)


def _may_pass(error: Exception, upstream: Upstream) -> bool:
    """Whether the same request to the same node may succeed later."""
    if isinstance(error, ClientResponseError):
        return error.status in TRANSIENT_STATUS
    return upstream.is_node or isinstance(error, SpoiledAnswer) or not isinstance(error, ValueError | TimeoutError)


def _shown(chain: int | RpcFailure) -> str:
    return hex(chain) if isinstance(chain, int) else chain.message


def _reason(error: Exception) -> str:
    match error:
        case ClientResponseError(__cause__=HttpProcessingError()):
            return "the answer is not HTTP"
        case ClientResponseError():
            return f"HTTP {error.status} {error.message}"
        case TimeoutError():
            return "no answer in time"
        case OSError() if error.strerror:
            return error.strerror
        case ValueError() if not isinstance(error, NotJsonRpc | SpoiledAnswer):
            return "the answer is not JSON"
    return str(error) or type(error).__name__

"""JSON-RPC over HTTP or WebSocket to one or several nodes, with retries.

A transport is one connection that stays open until it is closed. Every answer is checked here, before anything uses it.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from email.utils import parsedate_to_datetime
from functools import partial
from http import HTTPStatus
from itertools import count
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias, runtime_checkable
from urllib.parse import urlsplit

import msgspec
from aiohttp import ClientError, ClientResponse, ClientResponseError, ClientSession, ClientWebSocketResponse, WSMsgType
from aiohttp.http import HttpProcessingError

from mesh.base.log_context import log_event
from mesh.base.retry import Backoff, RetryPolicy
from mesh.chain._abi import SpoiledAnswer
from mesh.chain.answers import (
    ANSWER_LIMITS,
    ANSWERS,
    BlockHeader,
    OverQuota,
    RpcFailure,
    decode_answer,
    decode_revert,
    stated_wait,
)
from mesh.chain.errors import NodeUnreachable, RequestRefused
from mesh.errors import AiraError, ClosedError, ConfigurationError
from mesh.telemetry.metrics import MetricFamily, counter
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import Callable


class Transport(Protocol):
    """What carries requests to a node; web3's asynchronous providers do."""

    async def make_request(self, method: Any, params: Any) -> Any:
        """The node's response, a JSON object with a result or an error. Raises as `HttpTransport` does."""


@runtime_checkable
class PushingTransport(Transport, Protocol):
    """A transport whose node pushes new blocks."""

    def push_heads(self, on_head: Callable[[Any], None]) -> None:
        """Call `on_head` with each new block, as JSON, and with None when none is pushed any more.

        It is called in this event loop, until `end_pushes`. This may be called again and again.
        """

    def end_pushes(self, on_head: Callable[[Any], None]) -> None:
        """Call it no more. Unknown ones are ignored."""


class _Transport:
    """A connection to the node at an address; a request after `close` opens another."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._numbers = count()
        self._session: ClientSession | None = None

    def __str__(self) -> str:
        return self._url


class HttpTransport(_Transport):
    """A node at `http(s)://…`. Raises aiohttp's errors, `OSError`, and `ValueError` for an answer that is not JSON."""

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's response, with a result or an error."""
        if self._session is None:
            self._session = ClientSession(headers={"Content-Type": "application/json"})
        async with self._session.post(self._url, data=_encode(next(self._numbers), method, params)) as response:
            body = await _read(response)
            # Some nodes answer errors with HTTP 4xx or 5xx and a JSON-RPC error in the body.
            wait = _retry_after(response.headers.get("Retry-After", ""))
            if response.status == HTTPStatus.TOO_MANY_REQUESTS or (wait and response.status == 503):
                why = f"HTTP {response.status} {response.reason or ''}".strip()
                raise OverQuota(why, wait=max(wait, _wait_in(body)))
            if not response.ok and not body.lstrip().startswith(b"{"):
                response.raise_for_status()
            return _decode(body)

    async def close(self) -> None:
        """Close the connection."""
        session, self._session = self._session, None
        if session is not None:
            await session.close()


class WebSocketTransport(_Transport):
    """A node at `ws(s)://…`. Raises as `HttpTransport`, and `ConnectionError` for a lost connection."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._opening = asyncio.Lock()
        self._socket: ClientWebSocketResponse | None = None
        self._listening: asyncio.Task[None] | None = None
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._on_head: Callable[[Any], None] | None = None
        self._subscribing: asyncio.Task[None] | None = None
        self._subscription: Any = None
        self._is_stuck = False

    def replace(self) -> None:
        """The node did not answer in time: the next request opens another connection, even if this one is alive."""
        self._is_stuck = True
        self._fail_all(ConnectionResetError("the connection was replaced"))
        if self._on_head is not None:
            self._on_head(None)

    def push_heads(self, on_head: Callable[[Any], None]) -> None:
        """See `PushingTransport`. A node that has no such subscription is not asked again."""
        if self._on_head is None:
            self._on_head = on_head
            if self._socket is not None and not self._socket.closed:
                self._subscribing = asyncio.create_task(self._subscribe(), name="aira-chain-heads")

    def end_pushes(self, on_head: Callable[[Any], None]) -> None:
        """See `PushingTransport`."""
        if self._on_head is on_head:
            self._on_head = None

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's response, with a result or an error."""
        socket = await self._opened()
        number = next(self._numbers)
        answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            await socket.send_bytes(_encode(number, method, params))
            return await answer
        finally:
            self._waiting.pop(number, None)

    async def close(self) -> None:
        """Close the connection."""
        session, self._session, self._socket = self._session, None, None
        if session is not None:
            await session.close()
        if self._subscribing is not None:
            self._subscribing.cancel()
            self._subscribing = None
        if self._listening is not None:
            self._listening.cancel()
            with suppress(asyncio.CancelledError):
                await self._listening
            self._listening = None
        self._fail_all(ConnectionResetError("the connection was closed"))

    async def _opened(self) -> ClientWebSocketResponse:
        async with self._opening:
            if self._socket is None or self._socket.closed or self._is_stuck:
                await self.close()
                self._is_stuck = False
                self._session = ClientSession()
                size = ANSWER_LIMITS.size
                self._socket = await self._session.ws_connect(self._url, max_msg_size=size, heartbeat=30)
                self._listening = asyncio.create_task(self._read(self._socket), name="aira-chain-websocket")
                if self._on_head is not None:
                    self._subscribing = asyncio.create_task(self._subscribe(), name="aira-chain-heads")
            return self._socket

    async def _subscribe(self) -> None:
        """Ask for new blocks. A failure changes nothing: blocks are polled then."""
        with suppress(OSError, ValueError, ClientError):
            response = await self.make_request("eth_subscribe", ["newHeads"])
            self._subscription = response.get("result")

    async def _read(self, socket: ClientWebSocketResponse) -> None:
        """Deliver the answers to the requests that wait for them, until the connection ends."""
        async for message in socket:
            if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                self._deliver(message.data)
        self._fail_all(ConnectionResetError("the connection was closed"))
        self._subscription = None
        if self._on_head is not None:
            self._on_head(None)

    def _deliver(self, text: str | bytes) -> None:
        """Give an answer to the request with its id. One that names no request may be anybody's: all ask again."""
        try:
            response: Any = _decode(text)
            if isinstance(response, dict) and response.get("method") == "eth_subscription":
                self._take_pushed(response.get("params"))
                return
            number = response.get("id") if isinstance(response, dict) else None
            if not isinstance(number, int):
                raise SpoiledAnswer("an answer without the id of its request")
        except ValueError as error:
            self._fail_all(error)
            return
        answer = self._waiting.get(number)
        if answer is not None and not answer.done():
            answer.set_result(response)

    def _take_pushed(self, params: Any) -> None:
        is_ours = isinstance(params, dict) and params.get("subscription") == self._subscription
        if is_ours and self._on_head is not None and "result" in params:
            self._on_head(params["result"])

    def _fail_all(self, error: Exception) -> None:
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(error)


def _wait_in(body: bytes) -> float:
    """The seconds to wait that the data of an error states."""
    try:
        error = _decode(body)["error"]
        return stated_wait(error.get("data"))
    except (ValueError, TypeError, KeyError, AttributeError):
        return 0.0


def _retry_after(stated: str) -> float:
    """The seconds of a `Retry-After` header, which holds seconds or a date; 0 for anything else."""
    if stated.strip().isdecimal():
        return float(stated.strip()[:9])
    try:
        return max(0.0, parsedate_to_datetime(stated).timestamp() - time.time())
    except (ValueError, TypeError, OverflowError):
        return 0.0


async def _read(response: ClientResponse) -> bytes:
    """The body of an answer. Raises `SpoiledAnswer` above `ANSWER_LIMITS.size`."""
    body = bytearray()
    async for piece in response.content.iter_chunked(1 << 16):
        body += piece
        if len(body) > ANSWER_LIMITS.size:
            raise SpoiledAnswer(f"its answer is longer than {ANSWER_LIMITS.size} bytes")
    return bytes(body)


def _encode(number: int, method: str, params: Any) -> bytes:
    return msgspec.json.encode({"jsonrpc": "2.0", "id": number, "method": method, "params": params})


def _decode(text: str | bytes) -> Any:
    """The JSON of an answer. Raises `ValueError`: `SpoiledAnswer` for one that begins as an answer does."""
    try:
        return decode_json(text)
    except InvalidData:
        if text.lstrip()[:1] in (b"{", "{"):
            raise SpoiledAnswer("its answer is not JSON to the end") from None
        raise ValueError("the answer is not JSON") from None


log = logging.getLogger(__name__)

CONNECTION_ERRORS: Final = (OSError, TimeoutError, ClientError, ValueError)
"""What transports raise for a missing node, a lost connection and an answer that is not JSON; and `SpoiledAnswer`."""

Connection: TypeAlias = HttpTransport | WebSocketTransport
Endpoint: TypeAlias = "str | Transport | Sequence[str | Transport]"

SEND: Final = "eth_sendRawTransaction"
CHAIN_ID: Final = "eth_chainId"
TRANSIENT_STATUS: Final = frozenset({500, 502, 503, 504})


class QuotaPace(NamedTuple):
    """How nodes are asked again that are over their quota, in seconds."""

    retry: RetryPolicy = RetryPolicy(initial=0.1, ceiling=8.0)
    patience: float = 60.0
    """For which a request is asked again, or as long as they ask to wait."""
    silence: float = 2.0
    """Of such a wait after which it is logged, once until a node answers."""
    longest: float = 30.0
    """Between two such requests, whatever the nodes ask for."""


QUOTA_PACE: Final = QuotaPace()


class Upstream:
    """One of the nodes. `owned` is its connection, if that is closed with the client."""

    def __init__(self, transport: Transport, *, endpoint: str, owned: Connection | None = None) -> None:
        self.endpoint = endpoint
        self.owned = owned
        self.pushing = transport if isinstance(transport, PushingTransport) else None
        """The same, if its node may push new blocks."""
        self.on_head: Callable[[Any], None] | None = None
        """What it calls with them."""
        self._transport = transport
        self._secrets = secrets_in(endpoint)
        self.is_on_chain = False
        """Whether it said that it is on the chain of the others."""
        self.is_node = False
        """Whether it has answered as a node does, so that it is one although it may fail to do so at times."""

    @classmethod
    def at(cls, url: str) -> Upstream:
        """The node at an address. Raises `ConfigurationError` for a text that is none."""
        transport: Connection
        if url.startswith(("http://", "https://")):
            transport = HttpTransport(url)
        elif url.startswith(("ws://", "wss://")):
            transport = WebSocketTransport(url)
        else:
            raise ConfigurationError(
                f"{url!r} is not the address of a node",
                hint="an address begins with http://, https://, ws:// or wss://; several are separated by commas",
                code="invalid-endpoint",
            )
        return cls(transport, endpoint=url, owned=transport)

    async def ask(self, method: str, params: Any, kind: Any) -> tuple[dict[str, Any], Any]:
        """Its response to one request, and the result or `RpcFailure`. Raises `CONNECTION_ERRORS`."""
        response: Any = await self._transport.make_request(method, params)
        if not isinstance(response, dict) or not response.keys() & {"jsonrpc", "result", "error"}:
            raise ValueError("what answers is not a JSON-RPC server")
        if isinstance(error := response.get("error"), dict) and isinstance(message := error.get("message"), str):
            for secret in self._secrets:  # some quote their customer's key
                message = message.replace(secret, "…")
            response = response | {"error": error | {"message": message}}
        try:
            answer = decode_answer(method, response, kind)
        except OverQuota:
            self.is_node = True
            raise
        self.is_node = True
        return response, answer

    async def chain_id(self) -> int | RpcFailure:
        """The number of its chain. Raises as `ask`."""
        found: int | RpcFailure = (await self.ask(CHAIN_ID, [], ANSWERS[CHAIN_ID]))[1]
        return found


def secrets_in(url: str) -> tuple[str, ...]:
    """The parts of a node's URL that may be a customer's key: user, password, parts of the path, query."""
    parts = urlsplit(url)
    user, _, _ = parts.netloc.rpartition("@")
    words = re.split(r"[:/?&=#]", f"{user}/{parts.path}/{parts.query}/{parts.fragment}")
    keys = (word for word in words if len(word) >= 8)  # shorter ones are words such as `v3`
    return tuple(sorted(keys, key=len, reverse=True))


class RpcClient:
    """One or several nodes, with bounded retries.

    The nodes are at an endpoint: `http(s)://…`, `ws(s)://…`, a `Transport`, or several of them, as a sequence or as one
    text with commas. Nothing is connected yet. Raises `ConfigurationError` for any other text. An answer may take
    `timeout` seconds, and `first_timeout` that of a server that has not answered yet as a node does.

    A request goes to the node that answered last; if its connection fails or its answer is spoiled, to the next, and
    so on around all of them, again and again by `retry`. Only a transaction goes to one node once, because its sender
    must know whether an earlier attempt may have arrived; the sender's next attempt goes to the next node. A node that
    is over its quota is asked again when it says, or a little later each time. A node on another chain than the first
    that answered is an error when opening, if it answers soon, and skipped later.
    """

    def __init__(self, endpoint: Endpoint, *, retry: RetryPolicy, timeout: float, first_timeout: float) -> None:
        given = endpoint if isinstance(endpoint, Sequence) and not isinstance(endpoint, str) else [endpoint]
        upstreams: list[Upstream] = []
        for one in given or [""]:
            if isinstance(one, str):
                upstreams += [Upstream.at(url.strip()) for url in one.split(",")]
            else:
                upstreams.append(Upstream(one, endpoint=str(one)))
        self.endpoint = ", ".join(upstream.endpoint for upstream in upstreams)
        self._upstreams = tuple(upstreams)
        self._retry = retry
        self._timeout, self._first_timeout = timeout, min(first_timeout, timeout)
        self.failures = 0
        """Requests that no node answered in any attempt."""
        self.losses = 0
        """How often outages began."""
        self._answers = True
        self._expected: int | RpcFailure | None = None
        self._is_open = False
        self._is_over_quota = False
        """Whether it was logged that all nodes are over their quotas."""
        self._on_head: Callable[[BlockHeader | None], None] | None = None

    def families(self) -> tuple[MetricFamily, ...]:
        """How well the nodes answer."""
        return (
            counter("aira_node_failures_total", "Questions that no node of the chain answered", self.failures),
            counter("aira_node_losses_total", "How often the nodes of the chain fell silent", self.losses),
        )

    def open(self) -> None:
        """Let requests through, until `close`."""
        self._is_open = True

    def push_heads(self, on_head: Callable[[BlockHeader | None], None]) -> None:
        """Call `on_head` with each new block that the node in use pushes, and with None when it no longer does.

        Only over a `PushingTransport`, and only of the node that requests go to. May be called again and again.
        """
        self._on_head = on_head
        first = self._upstreams[0]
        if first.pushing is not None:
            first.on_head = first.on_head or partial(self._take_head, first)
            first.pushing.push_heads(first.on_head)

    def _take_head(self, upstream: Upstream, pushed: Any) -> None:
        if upstream is not self._upstreams[0] or self._on_head is None:
            return
        try:
            head = None if pushed is None else decode_answer("newHeads", {"result": pushed}, BlockHeader)
        except SpoiledAnswer as error:
            log.debug("%s: %s", upstream.endpoint, error)
        else:
            self._on_head(head)

    async def check_chains(self, expected: int) -> None:
        """Raise `ConfigurationError` if a node that answers soon is on another chain."""
        if len(self._upstreams) == 1:
            return
        found = await asyncio.gather(*(self._chain_of(upstream) for upstream in self._upstreams))
        for upstream, chain_id in zip(self._upstreams, found, strict=True):
            if chain_id is None:
                facts = log_event("node-silent", node=upstream.endpoint)
                silent = "the node %s does not answer; it is asked when another fails"
                log.warning(silent, upstream.endpoint, extra=facts)
            elif chain_id != expected:
                raise ConfigurationError(
                    f"the node {upstream.endpoint} is on the chain {chain_id}, the others are on the chain {expected}",
                    hint="name nodes of one chain only",
                    code="wrong-chain",
                )

    async def _chain_of(self, upstream: Upstream) -> int | None:
        """The number of a node's chain; None if it does not answer."""
        try:
            async with asyncio.timeout(2.0):  # opening waits for it
                found = await upstream.chain_id()
        except CONNECTION_ERRORS:
            return None
        return found if isinstance(found, int) else None

    async def request(self, method: str, params: Any, *, kind: Any = Any) -> Any:
        """The node's result, of the type `kind` (see `mesh.chain.answers`).

        Raises `NodeUnreachable` after the last attempt, `Reverted`, `RequestRefused`, `ClosedError`.
        """
        answer = (await self.answered(method, params, kind))[1]
        if isinstance(answer, RpcFailure):
            raise decode_revert(answer) or RequestRefused(method, answer.code, answer.message)
        return answer

    async def answered(self, method: str, params: Any, kind: Any) -> tuple[dict[str, Any], Any]:
        """A response of a node, and what it says: a result of the type `kind`, or an `RpcFailure`."""
        if not self._is_open:
            raise ClosedError("the connection to the node is not open: use it with `async with`")
        backoff, quota = Backoff(self._retry), Backoff(QUOTA_PACE.retry)
        began = asyncio.get_running_loop().time()
        while True:
            may_pass = False
            waits: list[float] = []
            for upstream in self._upstreams:
                try:
                    answered = await self._ask(upstream, method, params, kind)
                    self._answers, self._is_over_quota = True, False
                    return answered
                except AiraError:
                    raise
                except CONNECTION_ERRORS as error:
                    failure = error
                    if isinstance(error, OverQuota):
                        waits.append(error.wait)
                    may_pass = may_pass or _may_pass(error, upstream)
                    reason = _reason(error)
                    self._demote(upstream, reason)
                    if len(self._upstreams) > 1:
                        reason = f"{upstream.endpoint}: {reason}"
                    if method == SEND and not isinstance(error, OverQuota):
                        break  # it may have arrived
            log.debug("%s failed (%s)", method, reason)
            is_sent = method == SEND and not isinstance(failure, OverQuota)
            waited = asyncio.get_running_loop().time() - began
            if waits and not is_sent and waited < QUOTA_PACE.patience:
                # The nodes are there and say when to come back, so this does not count as an attempt.
                wait = min(max(min(waits), quota.next_delay() or 0.0), QUOTA_PACE.longest)
                if waited + wait > QUOTA_PACE.silence and not self._is_over_quota:
                    self._is_over_quota = True
                    facts = log_event("node-over-quota", node=self.endpoint, reason=reason)
                    log.warning("the node %s is %s; asking again", self.endpoint, reason, extra=facts)
                await asyncio.sleep(wait)
            elif is_sent or not may_pass or not await backoff.wait():
                break
        self.failures += 1
        self.losses += self._answers
        self._answers = False
        raise NodeUnreachable(self.endpoint, reason) from failure

    async def _ask(self, upstream: Upstream, method: str, params: Any, kind: Any) -> tuple[dict[str, Any], Any]:
        """What a node answers, as `answered`. Raises `CONNECTION_ERRORS`."""
        async with asyncio.timeout(self._timeout if upstream.is_node else self._first_timeout) as limit:
            if not upstream.is_on_chain and len(self._upstreams) > 1:
                await self._check_chain(upstream)
            try:
                return await upstream.ask(method, params, kind)
            except asyncio.CancelledError:
                # Too late, or given up by who asked: only the first means that the connection is stuck.
                if limit.expired() and isinstance(upstream.owned, WebSocketTransport):
                    upstream.owned.replace()
                raise

    async def _check_chain(self, upstream: Upstream) -> None:
        found = await upstream.chain_id()
        if self._expected is None:
            self._expected = found
        if found != self._expected:
            raise ValueError(f"it is on the chain {_shown(found)}, the others are on {_shown(self._expected)}")
        upstream.is_on_chain = True

    def _demote(self, upstream: Upstream, reason: str) -> None:
        """Ask another node first from now on, and the one that failed last."""
        upstream.is_on_chain = False  # it may come back as another
        if len(self._upstreams) > 1 and self._upstreams[0] is upstream:
            self._upstreams = (*self._upstreams[1:], upstream)
            if self._on_head is not None:
                self._on_head(None)
            following = self._upstreams[0].endpoint
            facts = log_event("node-switched", failed=upstream.endpoint, reason=reason, next=following)
            log.warning("the node %s fails (%s); switching to %s", upstream.endpoint, reason, following, extra=facts)

    async def close(self) -> None:
        """Close the connections that this side opened; further requests raise `ClosedError`."""
        self._is_open = False
        for upstream in self._upstreams:
            if upstream.pushing is not None and upstream.on_head is not None:
                upstream.pushing.end_pushes(upstream.on_head)
            if upstream.owned is not None:
                await upstream.owned.close()


def _may_pass(error: Exception, upstream: Upstream) -> bool:
    """Whether the same request to the same node may succeed later."""
    if isinstance(error, OverQuota):
        return True
    if isinstance(error, ClientResponseError):
        return error.status in TRANSIENT_STATUS
    return upstream.is_node or isinstance(error, SpoiledAnswer) or not isinstance(error, ValueError | TimeoutError)


def is_answered(error: NodeUnreachable | RequestRefused) -> bool:
    """Whether a node answers, and only lacks what was asked for, as a block or the state of an old one."""
    return isinstance(error, RequestRefused) or isinstance(error.__cause__, SpoiledAnswer)


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
    return str(error) or type(error).__name__

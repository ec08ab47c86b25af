"""JSON-RPC 2.0 as Ethereum nodes speak it: requests, batches and subscriptions, over HTTP and WebSocket in front of a
provider, so that several processes share one embedded chain.

Quantities are hexadecimal without leading zeros (`0x0`, `0x1f`), data is hexadecimal with two digits a byte (`0x`,
`0x01ff`); both as in the execution API specification. `eth_subscribe` works for any provider: new blocks and logs are
polled, and pushed to the subscribers. As geth does it: `newHeads` sends the header of each new block, `logs` the logs
of each that a query accepts. When blocks are replaced, their logs are sent once more with `removed`, the newest first,
then those of the new blocks.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections import deque
from contextlib import suppress
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

from aiohttp import WSMsgType, web

from mesh.base.door import DoorLimits
from mesh.base.http_server import HttpServer
from mesh.base.log_context import log_event
from mesh.chain.errors import METHOD_NOT_FOUND
from mesh.errors import AiraError
from schemas.decoding import InvalidData, decode_json

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from typing import Self

    from mesh.chain.rpc import Transport


log = logging.getLogger(__name__)


class RpcCode(IntEnum):
    """The codes of errors: those of JSON-RPC, and from -32000 to -32005 those of Ethereum's nodes."""

    PARSE_ERROR = -32700
    INVALID_REQUEST = -32600
    INVALID_PARAMS = -32602
    INTERNAL_ERROR = -32603
    SERVER_ERROR = -32000
    RESPONSE_TOO_LARGE = -32003
    LIMIT_EXCEEDED = -32005


class BatchLimits(NamedTuple):
    """What one text with requests may ask."""

    size: int = 4 << 20
    """Bytes of it."""
    requests: int = 1_000
    """Requests in a batch."""
    answers: int = 25_000_000
    """Bytes of the answers to a batch; the requests that come after are refused."""
    inline: int = 50_000
    """Texts up to this size are parsed on the event loop; larger ones, and all answers, in a thread."""


BATCH_LIMITS: Final = BatchLimits()

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
    if 0 <= number < 2**256:
        return number
    raise RpcError(RpcCode.INVALID_PARAMS, f"{str(value)[:80]!r} is not a quantity (0x…)")


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
        raise RpcError(RpcCode.INVALID_PARAMS, f"{str(value)[:80]!r} is not data{size} (0x…)")
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

    def __init__(self, provider: Transport, *, max_response_bytes: int = BATCH_LIMITS.answers) -> None:
        self._provider = provider
        self._max_response_bytes = max_response_bytes

    async def respond(self, text: str | bytes, *, methods: Mapping[str, Method] | None = None) -> str | None:
        """The response to a request or a batch, as JSON; None for notifications, which get none.

        `methods` are those of the connection it came on.
        """
        try:
            body = decode_json(text) if len(text) < BATCH_LIMITS.inline else await asyncio.to_thread(decode_json, text)
        except InvalidData:
            return json.dumps(_failure(None, RpcCode.PARSE_ERROR, "the body is not JSON"))
        if not isinstance(body, list):
            return await self._answer(body, methods or {})
        if not 0 < len(body) <= BATCH_LIMITS.requests:
            return json.dumps(
                _failure(None, RpcCode.INVALID_REQUEST, f"a batch holds 1 to {BATCH_LIMITS.requests} requests")
            )
        answers: list[str] = []
        size = 0
        for request in body:
            if size > self._max_response_bytes:
                id_ = request.get("id") if isinstance(request, dict) else None
                answer: str | None = json.dumps(_failure(id_, RpcCode.RESPONSE_TOO_LARGE, "response too large"))
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
                _failure(None, RpcCode.INVALID_REQUEST, "a request is an object with jsonrpc, id, method and params")
            )
        id_, params = request.get("id"), request.get("params", [])
        if not isinstance(params, list):
            return json.dumps(_failure(id_, RpcCode.INVALID_PARAMS, "params are a list"))
        answer = await self._call(request["method"], params, id_, methods)
        return await asyncio.to_thread(json.dumps, answer) if "id" in request else None

    async def _call(self, method: str, params: list[Any], id_: Any, methods: Mapping[str, Method]) -> dict[str, Any]:
        try:
            result = await (methods[method](params) if method in methods else self.ask(method, params))
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": id_, "error": error.as_object()}
        except AiraError as error:
            return _failure(id_, RpcCode.INTERNAL_ERROR, str(error))
        except Exception:
            log.exception("%s failed", method, extra=log_event("rpc-method-failed", method=method))
            return _failure(id_, RpcCode.INTERNAL_ERROR, f"{method} failed")
        return {"jsonrpc": "2.0", "id": id_, "result": result}


def _failure(id_: Any, code: int, message: str) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": id_, "error": {"code": code, "message": message}}


MAX_ALTERNATIVES: Final = 1_000
"""Addresses in a query of logs, or topics in one place."""

BODY: Final = frozenset({"transactions", "uncles", "withdrawals", "size", "totalDifficulty"})
"""Members of a block that are not in its header."""

Ask: TypeAlias = "Callable[[str, list[Any]], Awaitable[Any]]"
"""Asks the node a method with parameters; its result. Raises `RpcError`, or what its connection raises."""
Notify: TypeAlias = "Callable[[dict[str, Any]], None]"
"""Takes a notification, without waiting."""


class LogFilter:
    """The `address` and `topics` of a log query: any of some addresses, any of some topics in each place.

    What the query leaves out accepts everything. Raises `RpcError` for an invalid query.
    """

    def __init__(self, query: object) -> None:
        if not isinstance(query, dict):
            raise RpcError(RpcCode.INVALID_PARAMS, "a query of logs is an object with address and topics")
        addresses, places = query.get("address") or [], query.get("topics") or []
        if not isinstance(places, list | tuple):
            raise RpcError(RpcCode.INVALID_PARAMS, "the topics of a query of logs are a list")
        if len(_alternatives(addresses)) > MAX_ALTERNATIVES:
            raise RpcError(RpcCode.INVALID_PARAMS, "exceed max addresses")
        if len(places) > 4 or any(len(_alternatives(place)) > MAX_ALTERNATIVES for place in places):
            raise RpcError(RpcCode.INVALID_PARAMS, "exceed max topics")
        bounds = [query.get("fromBlock"), query.get("toBlock")]
        if all(isinstance(bound, str) and bound.startswith("0x") for bound in bounds):
            first, last = map(parse_quantity, bounds)
            if first > last:
                raise RpcError(RpcCode.INVALID_PARAMS, "invalid block range params")
        self._addresses = {_hex(parse_data(address, length=20)) for address in _alternatives(addresses)}
        self._topics: Sequence[set[str] | None] = [
            None if place is None else {_hex(parse_data(topic, length=32)) for topic in _alternatives(place)}
            for place in places
        ]

    def accepts(self, log: dict[str, Any]) -> bool:
        """Whether a log, as JSON-RPC has it, is asked for."""
        if self._addresses and log["address"] not in self._addresses:
            return False
        if len(self._topics) > len(log["topics"]):
            return False
        places = zip(log["topics"], self._topics, strict=False)
        return all(wanted is None or topic in wanted for topic, wanted in places)


def _alternatives(value: Any) -> list[Any]:
    """A member of a log query as the list of what it accepts."""
    return list(value) if isinstance(value, list | tuple) else [value]


def _hex(data: bytes) -> str:
    return "0x" + data.hex()


class _Block(NamedTuple):
    """A block that the subscribers were notified of."""

    number: int
    hash: str
    logs: Sequence[dict[str, Any]]


class _Subscription(NamedTuple):
    """A subscription to the logs that `log_filter` accepts, or to all new heads (None)."""

    log_filter: LogFilter | None
    notify: Notify


class Subscriptions:
    """The subscriptions of one server: `async with Subscriptions(ask)`. Polls only while there are any, each
    `poll_interval` seconds."""

    def __init__(self, ask: Ask, *, poll_interval: float = 0.05) -> None:
        self._ask = ask
        self._poll_interval = poll_interval
        self._subscriptions: dict[str, _Subscription] = {}
        self._sent: deque[_Block] = deque(maxlen=128)  # to notice that blocks were replaced
        self._polling = asyncio.Lock()
        self._has_subscribers = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._run(), name="aira-chain-subscriptions")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def add(self, params: Sequence[Any], notify: Notify) -> str:
        """Subscribe to what happens from now on; the id. Raises `RpcError` for an unknown kind of subscription."""
        log_filter = _parse(params)
        # Blocks that exist already are for the earlier subscribers, not for this one.
        await self._poll()
        subscription_id = "0x" + secrets.token_hex(16)
        self._subscriptions[subscription_id] = _Subscription(log_filter, notify)
        self._has_subscribers.set()
        return subscription_id

    def remove(self, subscription_id: object) -> bool:
        """End a subscription; False if there was none."""
        found = self._subscriptions.pop(subscription_id, None) if isinstance(subscription_id, str) else None
        if not self._subscriptions:
            self._has_subscribers.clear()
            self._sent.clear()
        return found is not None

    async def _run(self) -> None:
        is_lost = False
        while True:
            await self._has_subscribers.wait()
            try:
                await self._poll()
                is_lost = False
            except Exception as error:
                if not is_lost:
                    log.warning(
                        "can't read new blocks, trying again: %s",
                        error,
                        extra=log_event("rpc-polling-failed", error=error),
                    )
                is_lost = True
            await asyncio.sleep(self._poll_interval)

    async def _poll(self) -> None:
        """Send what has changed since the last poll; the first one only remembers the head of the chain."""
        async with self._polling:
            head = await self._ask("eth_getBlockByNumber", ["latest", False])
            if not self._sent or not self._subscriptions:
                self._sent.clear()
                self._sent.append(_Block(int(head["number"], 16), head["hash"], ()))
                return
            if self._sent[-1].hash == head["hash"]:
                return
            await self._send_removed(int(head["number"], 16))
            for number in range(self._sent[-1].number + 1, int(head["number"], 16) + 1):
                if not await self._send_block(number):
                    return

    async def _send_removed(self, head: int) -> None:
        """Forget the blocks that are not on the chain any more, and send their logs as removed."""
        lowest = head
        while self._sent:
            newest = self._sent[-1]
            if newest.number <= head:
                block = await self._ask("eth_getBlockByNumber", [hex(newest.number), False])
                if block is not None and block["hash"] == newest.hash:
                    return
            self._sent.pop()
            lowest = min(lowest, newest.number)
            for entry in reversed(newest.logs):
                self._send_log(entry | {"removed": True})
        self._sent.append(_Block(lowest - 1, "", ()))

    async def _send_block(self, number: int) -> bool:
        """Send a block's header and logs; False if the chain does not have it any more."""
        block = await self._ask("eth_getBlockByNumber", [hex(number), False])
        if block is None:
            return False
        logs = await self._ask("eth_getLogs", [{"blockHash": block["hash"]}])
        self._sent.append(_Block(number, block["hash"], logs))
        header = {name: value for name, value in block.items() if name not in BODY}
        for subscription_id, subscription in list(self._subscriptions.items()):
            if subscription.log_filter is None:
                subscription.notify(_notification(subscription_id, header))
        for entry in logs:
            self._send_log(entry)
        return True

    def _send_log(self, entry: dict[str, Any]) -> None:
        for subscription_id, subscription in list(self._subscriptions.items()):
            if subscription.log_filter is not None and subscription.log_filter.accepts(entry):
                subscription.notify(_notification(subscription_id, entry))


def _parse(params: Sequence[Any]) -> LogFilter | None:
    match list(params):
        case ["newHeads"] | ["newHeads", _]:
            return None
        case ["logs"]:
            return LogFilter({})
        case ["logs", query]:
            return LogFilter({} if query is None else query)
        case [str(kind), *_]:
            raise RpcError(METHOD_NOT_FOUND, f"there is no subscription {kind[:40]!r}, only newHeads and logs")
    raise RpcError(RpcCode.INVALID_PARAMS, "eth_subscribe takes newHeads, or logs and a query of logs")


def _notification(subscription_id: str, result: Any) -> dict[str, Any]:
    return {
        "jsonrpc": "2.0",
        "method": "eth_subscription",
        "params": {"subscription": subscription_id, "result": result},
    }


LIMITS: Final = DoorLimits(connections=512, per_address=512)
"""All of its clients are on this machine, as a rule."""


class SocketLimits(NamedTuple):
    """What clients may use of a server's WebSockets."""

    connections: int = 200
    """WebSockets that are open at once; more are refused with HTTP 503."""
    subscriptions: int = 100
    """Subscriptions of one of them."""
    unsent: int = 10_000
    """Messages that wait for a client to read them; a client that falls further behind is disconnected."""
    unsent_bytes: int = 64_000_000
    """Bytes of them."""
    heartbeat: float = 30.0
    """Seconds between two pings."""


SOCKET_LIMITS: Final = SocketLimits()
LOOPBACK_NAMES: Final = frozenset({"127.0.0.1", "localhost", "[::1]", "::1"})


class JsonRpcServer:
    """Serves `provider` (the embedded chain's, or another whose results are JSON).

    Requests are sent by POST or over a WebSocket, at the same address; a WebSocket also has `eth_subscribe` (`newHeads`
    and `logs`) and `eth_unsubscribe`.

    It listens on loopback by default. Web pages may not call it; a loopback server also refuses requests that name
    another host, as after DNS rebinding.

    Used with `async with`; leaving it finishes the requests in progress. Entering raises `PortUnavailable` when the
    port is taken.
    """

    def __init__(
        self,
        provider: Transport,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        max_response_bytes: int = BATCH_LIMITS.answers,
    ) -> None:
        self._dispatcher = Dispatcher(provider, max_response_bytes=max_response_bytes)
        self._subscriptions: Subscriptions | None = None
        self._connections: set[WebSocketConnection] = set()
        self._host = host
        self._port = port
        self._server: HttpServer | None = None

    @property
    def url(self) -> str:
        """Where it listens, with the actual port."""
        return f"http://{self._host}:{self._port}"

    @property
    def ws_url(self) -> str:
        """The address for WebSockets."""
        return f"ws://{self._host}:{self._port}"

    @property
    def connections(self) -> int:
        """How many WebSockets are open."""
        return len(self._connections)

    async def __aenter__(self) -> Self:
        app = web.Application(client_max_size=BATCH_LIMITS.size)
        app.router.add_post("/", self._post)
        app.router.add_get("/", self._open_socket)
        app.cleanup_ctx.append(self._run_subscriptions)
        app.on_shutdown.append(self._close_sockets)
        self._server = HttpServer(app, self._host, self._port, limits=LIMITS)
        await self._server.__aenter__()
        self._port = self._server.port
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._server is not None:
            await self._server.__aexit__(*exc_info)
            self._server = None

    async def _run_subscriptions(self, _app: web.Application) -> AsyncIterator[None]:
        async with Subscriptions(self._dispatcher.ask) as self._subscriptions:
            yield

    async def _close_sockets(self, _app: web.Application) -> None:
        for connection in list(self._connections):
            await connection.close()

    async def _post(self, request: web.Request) -> web.Response:
        self._check_sender(request)
        answer = await self._dispatcher.respond(await request.read())
        if answer is None:
            return web.Response(status=204)
        return web.Response(text=answer, content_type="application/json")

    async def _open_socket(self, request: web.Request) -> web.StreamResponse:
        self._check_sender(request)
        socket = web.WebSocketResponse(heartbeat=SOCKET_LIMITS.heartbeat, max_msg_size=BATCH_LIMITS.size)
        if not socket.can_prepare(request):
            raise web.HTTPUpgradeRequired(text="this is a node: POST JSON-RPC here, or open a WebSocket")
        if len(self._connections) >= SOCKET_LIMITS.connections:
            raise web.HTTPServiceUnavailable(text="too many WebSockets are open")
        assert self._subscriptions is not None
        connection = WebSocketConnection(request, socket, self._dispatcher, self._subscriptions)
        self._connections.add(connection)
        try:
            await socket.prepare(request)
            await connection.run()
        finally:
            self._connections.discard(connection)
        return socket

    def _check_sender(self, request: web.Request) -> None:
        """Raise HTTP 403 for a request of a web page, or for another host."""
        name = (request.host or "").rpartition(":")[0] or request.host
        if self._host in LOOPBACK_NAMES and name not in LOOPBACK_NAMES:
            raise web.HTTPForbidden(text="this node serves its own machine only")
        if "Origin" in request.headers:
            raise web.HTTPForbidden(text="web pages may not ask this node")


class WebSocketConnection:
    """One WebSocket: answers its requests one after another, and sends what it subscribed to."""

    def __init__(
        self, request: web.Request, socket: web.WebSocketResponse, dispatcher: Dispatcher, subscriptions: Subscriptions
    ) -> None:
        self._request = request
        self._socket = socket
        self._dispatcher = dispatcher
        self._subscriptions = subscriptions
        self._own_ids: set[str] = set()
        self._unsent: asyncio.Queue[str] = asyncio.Queue()
        self._unsent_bytes = 0
        self._held: list[str] | None = None
        """Notifications during a request: the id of a new subscription is sent before its first notification."""

    async def run(self) -> None:
        """Answer until either side closes the socket."""
        methods = {"eth_subscribe": self._subscribe, "eth_unsubscribe": self._unsubscribe}
        writing = asyncio.create_task(self._write(), name="aira-chain-socket-writer")
        try:
            async for message in self._socket:
                if message.type not in (WSMsgType.TEXT, WSMsgType.BINARY):
                    continue
                self._held = []
                answer = await self._dispatcher.respond(message.data, methods=methods)
                held, self._held = self._held, None
                for text in ([] if answer is None else [answer]) + held:
                    self._send(text)
        finally:
            for subscription_id in self._own_ids:
                self._subscriptions.remove(subscription_id)
            writing.cancel()
            await asyncio.wait([writing])

    async def close(self) -> None:
        """Close the socket because the server stops; one that is still being opened ends with its request."""
        if self._socket.prepared:
            await self._socket.close(code=1001, message=b"the node ends")

    async def _subscribe(self, params: list[Any]) -> str:
        if len(self._own_ids) >= SOCKET_LIMITS.subscriptions:
            raise RpcError(
                RpcCode.LIMIT_EXCEEDED, f"a connection has at most {SOCKET_LIMITS.subscriptions} subscriptions"
            )
        subscription_id = await self._subscriptions.add(params, self._notify)
        self._own_ids.add(subscription_id)
        return subscription_id

    async def _unsubscribe(self, params: list[Any]) -> bool:
        if len(params) != 1 or params[0] not in self._own_ids:
            raise RpcError(RpcCode.INVALID_PARAMS, "there is no such subscription on this connection")
        self._own_ids.remove(params[0])
        return self._subscriptions.remove(params[0])

    def _notify(self, notification: dict[str, Any]) -> None:
        text = json.dumps(notification)
        if self._held is None:
            self._send(text)
        elif len(self._held) < SOCKET_LIMITS.unsent:
            self._held.append(text)
        else:
            self._drop()

    def _send(self, text: str) -> None:
        self._unsent_bytes += len(text)
        if self._unsent.qsize() < SOCKET_LIMITS.unsent and self._unsent_bytes < SOCKET_LIMITS.unsent_bytes:
            self._unsent.put_nowait(text)
        else:
            self._drop()

    def _drop(self) -> None:
        if self._request.transport is not None:
            log.warning(
                "a client reads too slowly; disconnecting it",
                extra=log_event("rpc-client-dropped", client=self._request.remote),
            )
            self._request.transport.abort()

    async def _write(self) -> None:
        with suppress(ConnectionError):
            while True:
                text = await self._unsent.get()
                await self._socket.send_str(text)
                self._unsent_bytes -= len(text)

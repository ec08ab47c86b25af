"""What commercial providers of nodes, and nodes of other kinds, refuse, leave out and limit: a table, and a real server
that answers as one of its rows says, over HTTP and WebSocket, in front of a real chain.

The wordings are the providers' own, because programs have nothing else to go by.
"""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from aiohttp import ClientSession, WSMsgType, web

from tests.support.ports import free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

Answer = dict[str, Any]


def error(code: int, message: str, data: Any = None) -> Answer:
    """An error of JSON-RPC."""
    return {"error": {"code": code, "message": message} | ({} if data is None else {"data": data})}


@dataclass(frozen=True, kw_only=True)
class Provider:
    """How a provider's node differs from geth.

    `refuses` has the error for a method; `over_quota` the error for every second request, or its HTTP status as well;
    `drops` the fields that it leaves out, by method; `behind` the blocks by which every second answer about the latest
    state is older; `max_range` the blocks that one request for logs may span.
    """

    refuses: Mapping[str, Answer] = field(default_factory=dict)
    over_quota: Answer | None = None
    quota_status: int = 200
    drops: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    no_pending: Answer | None = None
    logs_want_address: Answer | None = None
    max_range: int = 0
    behind: int = 0


UNSUPPORTED = error(-32601, "the method eth_maxPriorityFeePerGas does not exist/is not available")

PROVIDERS: Mapping[str, Provider] = {
    "infura": Provider(
        over_quota=error(-32005, "project ID request rate exceeded", {"rate": {"backoff_seconds": 0.05}}),
        quota_status=429,
    ),
    "infura-in-200": Provider(
        over_quota=error(
            -32005, "daily request count exceeded, request rate limited", {"rate": {"backoff_seconds": 0.05}}
        )
    ),
    "alchemy": Provider(
        over_quota=error(
            429,
            "Your app has exceeded its compute units per second capacity. If you have retries enabled, ignore this.",
        )
    ),
    "quicknode": Provider(
        over_quota=error(-32007, "50/second request limit reached - reduce calls per second or upgrade your account"),
        max_range=5,
    ),
    "base-public": Provider(over_quota=error(-32016, "over rate limit")),
    "publicnode": Provider(
        logs_want_address=error(
            -32602, "Please specify an address in your request or, to remove restrictions, order a dedicated full node"
        )
    ),
    "ganache": Provider(
        refuses={"eth_maxPriorityFeePerGas": error(-32000, "Method eth_maxPriorityFeePerGas not supported.")}
    ),
    "hardhat": Provider(
        refuses={"eth_maxPriorityFeePerGas": error(-32004, "Method eth_maxPriorityFeePerGas is not supported")}
    ),
    "hedera-relay": Provider(refuses={"eth_maxPriorityFeePerGas": {"result": "0x"}}),
    "no-suggestions": Provider(refuses={"eth_maxPriorityFeePerGas": UNSUPPORTED, "eth_gasPrice": UNSUPPORTED}),
    "goquorum": Provider(
        drops={"eth_getTransactionReceipt": ("effectiveGasPrice",)}, refuses={"eth_maxPriorityFeePerGas": UNSUPPORTED}
    ),
    "nimbus": Provider(no_pending=error(-32000, "Unsupported block tag pending")),
    "null-pending": Provider(no_pending={"result": None}),
    "lagging-pool": Provider(behind=1),
}


class ProviderServer:
    """A provider in front of the node at `upstream`, at `url` and `ws_url` while it is entered; `asked` counts."""

    def __init__(self, provider: Provider, upstream: str) -> None:
        self.provider, self._upstream = provider, upstream
        self.port = free_port()
        self.url, self.ws_url = f"http://127.0.0.1:{self.port}", f"ws://127.0.0.1:{self.port}"
        self.asked: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.is_stuck = False
        """Whether it takes requests and answers none; a WebSocket still answers pings."""
        self._turn = False

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[ProviderServer]:
        """Serve until the end of the block."""
        app = web.Application(client_max_size=1 << 26)
        app.router.add_get("/", self._socket)
        app.router.add_post("/", self._post)
        runner = web.AppRunner(app)
        async with ClientSession() as self._session:
            await runner.setup()
            await web.TCPSite(runner, "127.0.0.1", self.port).start()
            try:
                yield self
            finally:
                await runner.cleanup()

    async def _post(self, request: web.Request) -> web.Response:
        asked = await request.json()
        while self.is_stuck:
            await asyncio.sleep(0.05)
        answer = await self._answer(asked)
        status = (
            self.provider.quota_status if answer.get("error") == (self.provider.over_quota or {}).get("error") else 200
        )
        return web.json_response(answer, status=status)

    async def _socket(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        async for message in socket:
            if message.type in (WSMsgType.TEXT, WSMsgType.BINARY) and not self.is_stuck:
                await socket.send_str(json.dumps(await self._answer(json.loads(message.data))))
        return socket

    async def _answer(self, asked: Mapping[str, Any]) -> Answer:
        method, params = asked["method"], list(asked.get("params") or [])
        head: Answer = {"jsonrpc": "2.0", "id": asked.get("id")}
        self.asked[method] += 1
        refused = self._refusal(method, params)
        if refused is not None:
            self.refused[method] += 1
            return head | refused
        if self.provider.behind and self._turn and "latest" in params:
            number = await self._pass_on({**asked, "method": "eth_blockNumber", "params": []})
            older = hex(max(0, int(number["result"], 16) - self.provider.behind))
            params = [older if one == "latest" else one for one in params]
        answer = await self._pass_on({**asked, "params": params})
        for name in self.provider.drops.get(method, ()):
            if isinstance(answer.get("result"), dict):
                answer["result"].pop(name, None)
        return answer

    def _refusal(self, method: str, params: list[Any]) -> Answer | None:
        provider = self.provider
        self._turn = not self._turn
        if method in provider.refuses:
            return provider.refuses[method]
        if provider.no_pending is not None and "pending" in params:
            return provider.no_pending
        if method == "eth_getLogs":
            query = params[0]
            if provider.logs_want_address is not None and not query.get("address"):
                return provider.logs_want_address
            if provider.max_range and "toBlock" in query:
                span = int(query["toBlock"], 16) - int(query["fromBlock"], 16) + 1
                if span > provider.max_range:
                    return error(-32602, f"eth_getLogs is limited to a {provider.max_range} range")
        return provider.over_quota if provider.over_quota is not None and self._turn else None

    async def _pass_on(self, asked: Mapping[str, Any]) -> Answer:
        async with self._session.post(self._upstream, json=asked) as response:
            answer: Answer = await response.json()
            return answer


def rows(*, where: Callable[[Provider], bool] = lambda provider: True) -> list[str]:
    """The names of the providers of which `where` holds."""
    return [name for name, provider in PROVIDERS.items() if where(provider)]

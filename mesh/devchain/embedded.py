"""An Ethereum node inside this process, for demos and tests: nothing to install, gone when it is closed."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mesh.devchain.jsonrpc import CHANGES, LIMIT_EXCEEDED, RUNS, RpcError
from mesh.devchain.rpc_server import JsonRpcServer
from mesh.errors import ClosedError
from mesh.extras import needs_extra

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from typing import Self

    from mesh.devchain.methods import Methods

T = TypeVar("T")


MAX_REQUESTS: Final = 1_000
"""Requests in progress at once."""
RUN_THREADS: Final = 2
RUN_SECONDS: Final = 5.0
"""What a call, an estimate or a transaction may compute, as in geth."""
MAX_LOGS: Final = 10_000
"""Logs, or blocks of a filter, in one response."""


class EmbeddedChain:
    """A private chain: eth-tester's py-evm in threads of its own, so that the event loop never waits for it.

    One thread changes the chain, one reads it, and two run calls: none waits for the others. A call, an estimate or a
    transaction that computes for more than `run_seconds` is refused, as is a query that finds more than `max_logs`,
    and a request while `max_requests` are in progress.

    Each transaction is mined at once, in a block of its own. With `block_time` (seconds) an empty block is mined
    that often as well, so that deadlines and turns, which count blocks, pass. The state lives in memory.

    Used with `async with`; `provider` and `mine` raise `ClosedError` after that. Cancelling a request leaves its work
    in the thread to finish.
    """

    def __init__(
        self,
        *,
        block_time: float | None = None,
        run_seconds: float = RUN_SECONDS,
        max_logs: int = MAX_LOGS,
        max_requests: int = MAX_REQUESTS,
    ) -> None:
        self._block_time = block_time
        self._run_seconds = run_seconds
        self._max_logs = max_logs
        self._max_requests = max_requests
        self._requests = 0
        self._threads: _Threads | None = None
        self._methods: Methods | None = None
        self._clock: asyncio.Task[None] | None = None
        self._funded_keys: tuple[bytes, ...] = ()
        self.provider = EmbeddedProvider(self)

    @property
    def funded_keys(self) -> tuple[bytes, ...]:
        """Private keys of ten accounts with 1,000,000 ETH each: those of anvil's accounts, in the same order."""
        return self._funded_keys

    async def __aenter__(self) -> Self:
        self._threads = _Threads()
        await self._in_thread(self._threads.changes, self._start)
        if self._block_time is not None:
            self._clock = asyncio.create_task(self._mine_by_time(self._block_time), name="aira-embedded-chain-clock")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._clock is not None:
            self._clock.cancel()
            with suppress(asyncio.CancelledError):
                await self._clock
        threads, self._threads, self._methods = self._threads, None, None
        if threads is not None:
            threads.close()

    async def mine(self, blocks: int = 1) -> None:
        """Mine that many empty blocks."""
        await self.request("evm_mine", [blocks])

    async def request(self, method: str, params: Any) -> Any:
        """The result of a JSON-RPC method. Raises `RpcError` for what the node refuses."""
        if self._threads is None:
            raise ClosedError("the embedded chain is closed")
        if self._requests >= self._max_requests:
            raise RpcError(LIMIT_EXCEEDED, f"{self._max_requests} requests are in progress")
        self._requests += 1
        try:
            return await self._in_thread(self._threads.of(method), lambda: self._opened().answer(method, params))
        finally:
            self._requests -= 1

    def _start(self) -> None:
        # Imported in the thread: py-evm takes most of a second to load.
        with needs_extra("demo", "the embedded chain"):
            from mesh.devchain.evm import Evm
            from mesh.devchain.methods import Methods
        evm = Evm(run_seconds=self._run_seconds, max_logs=self._max_logs)
        self._funded_keys = evm.funded_keys
        self._methods = Methods(evm)

    def _opened(self) -> Methods:
        if self._methods is None:
            raise ClosedError("the embedded chain is closed")
        return self._methods

    async def _in_thread(self, thread: ThreadPoolExecutor, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(thread, work)

    async def _mine_by_time(self, seconds: float) -> None:
        while True:
            await asyncio.sleep(seconds)
            await self.mine()


class _Threads:
    """The threads of an embedded chain, by what a method does."""

    def __init__(self) -> None:
        self.changes = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aira-embedded-chain-changes")
        self._reads = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aira-embedded-chain-reads")
        self._runs = ThreadPoolExecutor(max_workers=RUN_THREADS, thread_name_prefix="aira-embedded-chain-runs")

    def of(self, method: str) -> ThreadPoolExecutor:
        """The thread for a method."""
        if method in CHANGES:
            return self.changes
        return self._runs if method in RUNS else self._reads

    def close(self) -> None:
        for thread in (self.changes, self._reads, self._runs):
            thread.shutdown(wait=False, cancel_futures=True)


class EmbeddedProvider:
    """The transport of requests to an `EmbeddedChain`."""

    def __init__(self, chain: EmbeddedChain) -> None:
        self._chain = chain

    async def make_request(self, method: str, params: Any) -> Any:
        """A JSON-RPC response with the result or the error."""
        try:
            return {"jsonrpc": "2.0", "id": 0, "result": await self._chain.request(method, params)}
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": 0, "error": error.as_object()}

    def __str__(self) -> str:
        return "the embedded chain"


class ServedChain:
    """An embedded chain and the server in front of it."""

    def __init__(self, node: EmbeddedChain, server: JsonRpcServer) -> None:
        self.node = node
        self.server = server

    @property
    def url(self) -> str:
        """Where other processes reach it, e.g. `http://127.0.0.1:8545`."""
        return self.server.url

    @property
    def ws_url(self) -> str:
        """The same for clients that subscribe, e.g. `ws://127.0.0.1:8545`."""
        return self.server.ws_url


@asynccontextmanager
async def serve_embedded(
    host: str = "127.0.0.1", port: int = 8545, *, block_time: float | None = None
) -> AsyncIterator[ServedChain]:
    """An embedded chain that other processes share over JSON-RPC; port 0 takes a free one."""
    async with (
        EmbeddedChain(block_time=block_time) as node,
        JsonRpcServer(node.provider, host=host, port=port) as server,
    ):
        yield ServedChain(node, server)

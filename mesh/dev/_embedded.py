"""An Ethereum node inside this process, for demos and tests: nothing to install, gone when it is closed."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mesh.base.background import call_in_loop
from mesh.base.extras import needs_extra
from mesh.dev._rpc import CHANGES, RUNS, RpcCode, RpcError
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from typing import Self

    from mesh.dev._evm import Evm, Methods

T = TypeVar("T")


HISTORY: Final = 26
"""Seconds before its start at which a chain with a market begins: the blocks of its deployment, made in an instant."""


class EmbeddedChain:
    """A private chain: eth-tester's py-evm in threads of its own, so that the event loop never waits for it.

    One thread changes the chain, one reads it, and two run calls: none waits for the others. A call, an estimate or a
    transaction that computes for more than `run_seconds` (by default as in geth) is refused, as is a query that finds
    more than `max_logs` logs or blocks, and a request while `max_requests` are in progress.

    Each transaction is mined at once, in a block of its own. With `block_time` (seconds) an empty block is mined
    that often as well, so that deadlines and turns, which count blocks, pass. The state lives in memory.

    The time of a block is that of the clock. Each block is at least a second later than the one before, so after more
    than one a second the chain is ahead; then a `block_time` of a second or more leaves out blocks until it is not.
    What is deployed `in_the_past` does not put it ahead.

    Used with `async with`; `provider` and `mine` raise `ClosedError` after that. Cancelling a request leaves its work
    in the thread to finish.
    """

    def __init__(
        self,
        *,
        block_time: float | None = None,
        run_seconds: float = 5.0,
        max_logs: int = 10_000,
        max_requests: int = 1_000,
    ) -> None:
        self._block_time = block_time
        self._run_seconds = run_seconds
        self._max_logs = max_logs
        self._max_requests = max_requests
        self._requests = 0
        self._threads: dict[str, ThreadPoolExecutor] = {}
        """By what a method does; none while the chain is closed."""
        self._evm: Evm | None = None
        self._methods: Methods | None = None
        self._clock: asyncio.Task[None] | None = None
        self._listeners: dict[Callable[[Any], None], Callable[[Any], None]] = {}
        """Who is told of each new block, and how, from any thread."""
        self._pushed: Any = None
        """The block that they were told last."""
        self._funded_keys: tuple[bytes, ...] = ()
        self.provider = EmbeddedProvider(self)

    @property
    def funded_keys(self) -> tuple[bytes, ...]:
        """Private keys of ten accounts with 1,000,000 ETH each: those of anvil's accounts, in the same order."""
        return self._funded_keys

    async def __aenter__(self) -> Self:
        for does, most in (("changes", 1), ("reads", 1), ("runs", 2)):
            self._threads[does] = ThreadPoolExecutor(most, thread_name_prefix=f"aira-embedded-chain-{does}")
        await self._in_thread("changes", self._start)
        if self._block_time is not None:
            self._clock = asyncio.create_task(self._mine_by_time(self._block_time), name="aira-embedded-chain-clock")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._clock is not None:
            self._clock.cancel()
            with suppress(asyncio.CancelledError):
                await self._clock
        self._evm = self._methods = None
        while self._threads:
            self._threads.popitem()[1].shutdown(wait=False, cancel_futures=True)

    @asynccontextmanager
    async def in_the_past(self) -> AsyncIterator[None]:
        """Begin the chain again `HISTORY` seconds ago; in the body, its blocks are a second apart.

        Afterwards the chain is as late as the clock, if it has that many blocks. One that has blocks already stays.
        """
        await self._in_thread("changes", self._begin_in_the_past)
        try:
            yield
        finally:
            if self._evm is not None:
                self._evm.go_live()

    async def mine(self, blocks: int = 1) -> None:
        """Mine that many empty blocks."""
        await self.request("evm_mine", [blocks])

    def push_heads(self, on_head: Callable[[Any], None]) -> None:
        """From now on call `on_head` in this event loop with each new block (JSON), and first with the latest.

        It is called before who changed the chain has the answer, and now and then again with the same block.
        """
        if on_head not in self._listeners:
            push = self._listeners[on_head] = partial(call_in_loop, asyncio.get_running_loop(), on_head)
            if self._pushed is not None:
                push(self._pushed)

    def end_pushes(self, on_head: Callable[[Any], None]) -> None:
        """Call it no more."""
        self._listeners.pop(on_head, None)

    async def request(self, method: str, params: Any) -> Any:
        """The result of a JSON-RPC method. Raises `RpcError` for what the node refuses."""
        if self._requests >= self._max_requests:
            raise RpcError(RpcCode.LIMIT_EXCEEDED, f"{self._max_requests} requests are in progress")
        self._requests += 1
        try:
            does = "changes" if method in CHANGES else "runs" if method in RUNS else "reads"
            return await self._in_thread(does, lambda: self._answer(does, method, params))
        finally:
            self._requests -= 1

    def _start(self, history: int = 0) -> None:
        # Imported in the thread: py-evm takes most of a second to load.
        with needs_extra("demo", "the embedded chain"):
            from mesh.dev._evm import Evm, Methods
        self._evm = Evm(run_seconds=self._run_seconds, max_logs=self._max_logs, history=history)
        self._funded_keys = self._evm.funded_keys
        self._methods = Methods(self._evm)

    def _begin_in_the_past(self) -> None:
        if self._evm is not None and self._evm.head == 0:
            self._start(HISTORY)

    def _answer(self, does: str, method: str, params: Any) -> Any:
        try:
            return self._opened().answer(method, params)
        finally:
            if does == "changes":
                self._push()

    def _push(self) -> None:
        self._pushed = self._opened().answer("eth_getBlockByNumber", ["latest"])
        for push in tuple(self._listeners.values()):
            push(self._pushed)

    def _opened(self) -> Methods:
        if self._methods is None:
            raise ClosedError("the embedded chain is closed")
        return self._methods

    async def _in_thread(self, does: str, work: Callable[[], T]) -> T:
        if not self._threads:
            raise ClosedError("the embedded chain is closed")
        return await asyncio.get_running_loop().run_in_executor(self._threads[does], work)

    async def _mine_by_time(self, seconds: float) -> None:
        while True:
            await asyncio.sleep(seconds)
            if seconds < 1:
                await self.mine()
            else:
                await self._in_thread("changes", self._mine_on_time)

    def _mine_on_time(self) -> None:
        if self._evm is not None:
            self._evm.mine_on_time()
            self._push()


class EmbeddedProvider:
    """The transport of requests to an `EmbeddedChain`, which pushes each block at once."""

    def __init__(self, chain: EmbeddedChain) -> None:
        self._chain = chain
        self.in_the_past = chain.in_the_past
        self.push_heads = chain.push_heads
        self.end_pushes = chain.end_pushes

    async def make_request(self, method: str, params: Any) -> Any:
        """A JSON-RPC response with the result or the error."""
        try:
            return {"jsonrpc": "2.0", "id": 0, "result": await self._chain.request(method, params)}
        except RpcError as error:
            return {"jsonrpc": "2.0", "id": 0, "error": error.as_object()}

    def __str__(self) -> str:
        return "the embedded chain"

"""New blocks and logs pushed to who subscribed (`eth_subscribe`), for any provider: it is looked at again and again.

As geth does it: `newHeads` tells the header of each new block, `logs` the logs of each that a query accepts. When
blocks are replaced, their logs are told once more with `removed`, the newest first, then those of the new blocks.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from mesh.devchain.jsonrpc import INVALID_PARAMS, METHOD_NOT_FOUND, RpcError
from mesh.devchain.log_filter import LogFilter

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

log = logging.getLogger(__name__)

POLL_INTERVAL: Final = 0.05
"""Seconds between two looks for new blocks while somebody is subscribed."""

REMEMBERED: Final = 128
"""Blocks that are remembered, to notice that they were replaced."""

BODY: Final = frozenset({"transactions", "uncles", "withdrawals", "size", "totalDifficulty"})
"""Members of a block that are not in its header."""

Ask: TypeAlias = "Callable[[str, list[Any]], Awaitable[Any]]"
"""Asks the node a method with parameters; its result. Raises `RpcError`, or what its connection raises."""
Notify: TypeAlias = "Callable[[dict[str, Any]], None]"
"""Takes a notification, without waiting."""


class _Block(NamedTuple):
    """A block that was told."""

    number: int
    hash: str
    logs: Sequence[dict[str, Any]]


class _Subscription(NamedTuple):
    """Who hears of what: of all heads where there is no filter."""

    wanted: LogFilter | None
    notify: Notify


class Feed:
    """The subscriptions of one server: `async with Feed(ask) as feed`. Looks only while there are any."""

    def __init__(self, ask: Ask, *, poll_interval: float = POLL_INTERVAL) -> None:
        self._ask = ask
        self._poll_interval = poll_interval
        self._subscriptions: dict[str, _Subscription] = {}
        self._told: deque[_Block] = deque(maxlen=REMEMBERED)
        self._looking = asyncio.Lock()
        self._wanted = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Feed:
        self._task = asyncio.create_task(self._run(), name="aira-chain-feed")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def subscribe(self, params: Sequence[Any], notify: Notify) -> str:
        """Hear of what comes from now on; the subscription's name. Raises `RpcError` for another kind."""
        wanted = _parse(params)
        # What is there already is told to those who asked before, not to this one.
        await self._look()
        name = "0x" + secrets.token_hex(16)
        self._subscriptions[name] = _Subscription(wanted, notify)
        self._wanted.set()
        return name

    def unsubscribe(self, name: object) -> bool:
        """Hear no more; False if there was no such subscription."""
        found = self._subscriptions.pop(name, None) if isinstance(name, str) else None
        if not self._subscriptions:
            self._wanted.clear()
            self._told.clear()
        return found is not None

    async def _run(self) -> None:
        is_lost = False
        while True:
            await self._wanted.wait()
            try:
                await self._look()
                is_lost = False
            except Exception as error:
                if not is_lost:
                    log.warning("new blocks can't be read, trying again: %s", error)
                is_lost = True
            await asyncio.sleep(self._poll_interval)

    async def _look(self) -> None:
        """Tell of what has changed since the last look; the first only remembers where the chain ends."""
        async with self._looking:
            head = await self._ask("eth_getBlockByNumber", ["latest", False])
            if not self._told or not self._subscriptions:
                self._told.clear()
                self._told.append(_Block(int(head["number"], 16), head["hash"], ()))
                return
            if self._told[-1].hash == head["hash"]:
                return
            await self._take_back(int(head["number"], 16))
            for number in range(self._told[-1].number + 1, int(head["number"], 16) + 1):
                if not await self._tell(number):
                    return

    async def _take_back(self, head: int) -> None:
        """Forget the blocks that are not on the chain any more, and tell that their logs did not happen."""
        lowest = head
        while self._told:
            newest = self._told[-1]
            if newest.number <= head:
                block = await self._ask("eth_getBlockByNumber", [hex(newest.number), False])
                if block is not None and block["hash"] == newest.hash:
                    return
            self._told.pop()
            lowest = min(lowest, newest.number)
            for entry in reversed(newest.logs):
                self._notify_of_log(entry | {"removed": True})
        self._told.append(_Block(lowest - 1, "", ()))

    async def _tell(self, number: int) -> bool:
        """Tell of a block; False if it is gone again."""
        block = await self._ask("eth_getBlockByNumber", [hex(number), False])
        if block is None:
            return False
        logs = await self._ask("eth_getLogs", [{"blockHash": block["hash"]}])
        self._told.append(_Block(number, block["hash"], logs))
        header = {name: value for name, value in block.items() if name not in BODY}
        for name, subscription in list(self._subscriptions.items()):
            if subscription.wanted is None:
                subscription.notify(_notification(name, header))
        for entry in logs:
            self._notify_of_log(entry)
        return True

    def _notify_of_log(self, entry: dict[str, Any]) -> None:
        for name, subscription in list(self._subscriptions.items()):
            if subscription.wanted is not None and subscription.wanted.accepts(entry):
                subscription.notify(_notification(name, entry))


def _parse(params: Sequence[Any]) -> LogFilter | None:
    match list(params):
        case ["newHeads"] | ["newHeads", _]:
            return None
        case ["logs"]:
            return LogFilter({})
        case ["logs", query]:
            return LogFilter({} if query is None else query)
        case [str(kind), *_]:
            raise RpcError(METHOD_NOT_FOUND, f"there is no subscription {kind[:40]!r}, but newHeads and logs")
    raise RpcError(INVALID_PARAMS, "eth_subscribe takes newHeads, or logs and a query of logs")


def _notification(name: str, result: Any) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "method": "eth_subscription", "params": {"subscription": name, "result": result}}

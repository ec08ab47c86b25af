"""`eth_subscribe` for any provider: new blocks and logs are polled, and pushed to the subscribers.

As geth does it: `newHeads` sends the header of each new block, `logs` the logs of each that a query accepts. When
blocks are replaced, their logs are sent once more with `removed`, the newest first, then those of the new blocks.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from mesh.chain.errors import METHOD_NOT_FOUND
from mesh.devchain.jsonrpc import INVALID_PARAMS, RpcError, parse_data, parse_quantity
from mesh.log_context import log_event

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from typing import Self

log = logging.getLogger(__name__)

POLL_INTERVAL: Final = 0.05
"""Seconds between two polls for new blocks while there are subscribers."""

REMEMBERED: Final = 128
"""Blocks that are remembered, to notice that they were replaced."""

MAX_PLACES: Final = 4
"""Topics of a log."""
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
            raise RpcError(INVALID_PARAMS, "a query of logs is an object with address and topics")
        addresses, places = query.get("address") or [], query.get("topics") or []
        if not isinstance(places, list | tuple):
            raise RpcError(INVALID_PARAMS, "the topics of a query of logs are a list")
        if len(_alternatives(addresses)) > MAX_ALTERNATIVES:
            raise RpcError(INVALID_PARAMS, "exceed max addresses")
        if len(places) > MAX_PLACES or any(len(_alternatives(place)) > MAX_ALTERNATIVES for place in places):
            raise RpcError(INVALID_PARAMS, "exceed max topics")
        bounds = [query.get("fromBlock"), query.get("toBlock")]
        if all(isinstance(bound, str) and bound.startswith("0x") for bound in bounds):
            first, last = map(parse_quantity, bounds)
            if first > last:
                raise RpcError(INVALID_PARAMS, "invalid block range params")
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
    """The subscriptions of one server: `async with Subscriptions(ask)`. Polls only while there are any."""

    def __init__(self, ask: Ask, *, poll_interval: float = POLL_INTERVAL) -> None:
        self._ask = ask
        self._poll_interval = poll_interval
        self._subscriptions: dict[str, _Subscription] = {}
        self._sent: deque[_Block] = deque(maxlen=REMEMBERED)
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
    raise RpcError(INVALID_PARAMS, "eth_subscribe takes newHeads, or logs and a query of logs")


def _notification(subscription_id: str, result: Any) -> dict[str, Any]:
    return {
        "jsonrpc": "2.0",
        "method": "eth_subscription",
        "params": {"subscription": subscription_id, "result": result},
    }

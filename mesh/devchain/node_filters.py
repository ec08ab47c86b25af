"""Filters that the embedded node keeps for its clients (`eth_newFilter`, …), as the legacy JavaScript uses them.

A filter answers with what is new since it was asked last. New clients need none: `eth_getLogs` and subscriptions are
there.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

from mesh.devchain.jsonrpc import INVALID_PARAMS, SERVER_ERROR, RpcError, parse_quantity
from mesh.devchain.log_filter import LogFilter

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.devchain.evm import Evm

MAX_FILTERS: Final = 1_000
"""Filters that are kept; a further one takes the place of that which was asked least recently."""


class _Filter:
    """The query of a filter (None: it is of blocks), and the next block that it has not told of."""

    def __init__(self, query: dict[str, Any] | None, following: int) -> None:
        self.query = query
        self.following = following


class NodeFilters:
    """The filters of one node. `logs` answers a query, as `eth_getLogs` does. All raise `RpcError`."""

    def __init__(self, evm: Evm, logs: Callable[[dict[str, Any]], list[dict[str, Any]]]) -> None:
        self._evm = evm
        self._logs = logs
        self._filters: OrderedDict[str, _Filter] = OrderedDict()
        self._made = 0

    def of_logs(self, query: object) -> str:
        """A filter of the logs that a query accepts; its name."""
        LogFilter(query)  # raises for what is no query
        assert isinstance(query, dict)
        return self._add(query)

    def of_blocks(self) -> str:
        """A filter of the hashes of new blocks; its name."""
        return self._add(None)

    def changes(self, name: object) -> list[Any]:
        """What is new since the last time."""
        found = self._find(name)
        # The chain may have been taken back meanwhile.
        first = min(found.following, self._evm.head + 1)
        found.following = self._evm.head + 1
        if found.query is None:
            return [self._hash(number) for number in range(first, found.following)]
        if isinstance(found.query.get("fromBlock"), str) and found.query["fromBlock"].startswith("0x"):
            first = max(first, parse_quantity(found.query["fromBlock"]))
        logs = self._logs(found.query | {"fromBlock": first})
        return [log for log in logs if int(log["blockNumber"], 16) >= first]

    def everything(self, name: object) -> list[dict[str, Any]]:
        """All logs that a filter's query accepts."""
        query = self._find(name).query
        if query is None:
            raise RpcError(INVALID_PARAMS, "this filter is of blocks, not of logs")
        return self._logs(query)

    def remove(self, name: object) -> bool:
        """Forget a filter; False if there was none."""
        return self._filters.pop(str(name), None) is not None

    def _add(self, query: dict[str, Any] | None) -> str:
        self._made += 1
        name = hex(self._made)
        self._filters[name] = _Filter(query, self._evm.head + 1)
        if len(self._filters) > MAX_FILTERS:
            self._filters.popitem(last=False)
        return name

    def _find(self, name: object) -> _Filter:
        found = self._filters.get(str(name))
        if found is None:
            raise RpcError(SERVER_ERROR, "filter not found")
        self._filters.move_to_end(str(name))
        return found

    def _hash(self, number: int) -> str:
        block = self._evm.block(number, transactions="hashes")
        assert block is not None
        return str(block["hash"])

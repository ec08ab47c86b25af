"""The JSON-RPC methods of the embedded node, and the filters that it keeps for its clients.

Enough for this project's clients, web3.py, ethers and both legacy JavaScript clients, which also send transactions of
the node's unlocked accounts.
"""

from __future__ import annotations

from collections import OrderedDict
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.errors import METHOD_NOT_FOUND
from mesh.devchain.calls import parse_call
from mesh.devchain.evm import PRIORITY_FEE_WEI, Evm
from mesh.devchain.jsonrpc import (
    INTERNAL_ERROR,
    INVALID_PARAMS,
    LIMIT_EXCEEDED,
    SERVER_ERROR,
    RpcError,
    parse_data,
    parse_quantity,
    to_json,
)
from mesh.devchain.subscriptions import LogFilter
from mesh.devchain.unlocked import UnlockedAccounts
from schemas import keccak256

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

TAGS = frozenset({"latest", "pending", "safe", "finalized", "earliest"})

MAX_FILTERS: Final = 1_000
"""The most filters that are kept; a new one replaces the one that was used least recently."""


class Methods:
    """An `Evm` behind JSON-RPC method names."""

    def __init__(self, evm: Evm) -> None:
        self._evm = evm
        self._table: dict[str, Callable[..., Any]] = {
            **UnlockedAccounts(evm).methods(),
            **NodeFilters(evm, self._logs, self._bound).methods(),
            "web3_clientVersion": lambda: "aira-embedded/py-evm",
            "web3_sha3": lambda data: keccak256(parse_data(data)),
            "net_version": lambda: str(evm.chain_id),
            "net_listening": lambda: True,
            "net_peerCount": lambda: 0,
            "eth_syncing": lambda: False,
            "eth_chainId": lambda: evm.chain_id,
            "eth_blockNumber": lambda: evm.head,
            "eth_gasPrice": lambda: evm.base_fee + PRIORITY_FEE_WEI,
            "eth_maxPriorityFeePerGas": lambda: PRIORITY_FEE_WEI,
            "eth_getBalance": self._state(evm.balance),
            "eth_getTransactionCount": self._state(evm.nonce),
            "eth_getCode": self._state(evm.code),
            "eth_getStorageAt": self._storage,
            "eth_getBlockByNumber": self._block_by_number,
            "eth_getBlockByHash": self._block_by_hash,
            "eth_getTransactionByHash": lambda hash_: evm.transaction(parse_data(hash_, length=32)),
            "eth_getTransactionReceipt": lambda hash_: evm.receipt(parse_data(hash_, length=32)),
            "eth_getLogs": self._logs,
            "eth_call": lambda call, block="latest": evm.calls.call(parse_call(call), self._height(block)),
            "eth_estimateGas": lambda call, block="latest": evm.calls.estimate(parse_call(call), self._height(block)),
            "eth_sendRawTransaction": lambda raw: evm.send(parse_data(raw)),
            "evm_mine": self._mine,
            "evm_snapshot": lambda: evm.head,
            "evm_revert": self._revert,
        }

    def answer(self, method: str, params: Sequence[Any]) -> Any:
        """The result of a method, as JSON. Raises `RpcError` and nothing else, for any parameters."""
        function = self._table.get(method)
        if function is None:
            raise RpcError(METHOD_NOT_FOUND, f"the method {method} does not exist or is not available")
        try:
            return to_json(function(*params))
        except RpcError:
            raise
        except RecursionError:
            raise RpcError(SERVER_ERROR, "contracts call each other too deep for this node") from None
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            raise RpcError(INVALID_PARAMS, f"the parameters of {method} can't be: {error}") from error
        except Exception as error:
            raise RpcError(INTERNAL_ERROR, f"{method} failed: {type(error).__name__}: {error}") from error

    def _height(self, block: object) -> int:
        return self._evm.height(block if block in TAGS else parse_quantity(block))

    def _state(self, read: Callable[[bytes, int], Any]) -> Callable[..., Any]:
        def method(address: object, block: object = "latest") -> Any:
            return read(parse_data(address, length=20), self._height(block))

        return method

    def _storage(self, address: object, slot: object, block: object = "latest") -> bytes:
        return self._evm.storage(parse_data(address, length=20), parse_quantity(slot), self._height(block))

    def _block_by_number(self, block: object, full: object = False) -> dict[str, Any] | None:
        number = parse_quantity(block) if block not in TAGS else self._height(block)
        return self._evm.block(number, transactions="objects" if full else "hashes")

    def _block_by_hash(self, hash_: object, full: object = False) -> dict[str, Any] | None:
        return self._evm.block(parse_data(hash_, length=32), transactions="objects" if full else "hashes")

    def _mine(self, blocks: object = 1) -> str:
        self._evm.mine(parse_quantity(blocks))
        return "0x0"

    def _revert(self, snapshot: object) -> bool:
        self._evm.rewind(parse_quantity(snapshot))
        return True

    def _logs(self, query: dict[str, Any]) -> list[dict[str, Any]]:
        if "blockHash" in query:
            block = self._block_by_hash(query["blockHash"])
            if block is None:
                raise RpcError(INVALID_PARAMS, "unknown block")
            first = last = int(block["number"], 16)
        else:
            first = self._bound(query.get("fromBlock"))
            last = self._bound(query.get("toBlock"))
        wanted = LogFilter(query)
        found = list(
            islice((log for log in self._evm.logs(first, last) if wanted.accepts(log)), self._evm.max_logs + 1)
        )
        if len(found) > self._evm.max_logs:
            raise RpcError(LIMIT_EXCEEDED, f"query returned more than {self._evm.max_logs} results")
        return found

    def _bound(self, block: object) -> int:
        """A bound of a range of blocks, which may be past the head, unlike the block of a call."""
        return self._evm.height(block or "latest") if block is None or block in TAGS else parse_quantity(block)


class _Filter:
    """The query of a filter (None for new blocks), and the next block that it has not returned."""

    def __init__(self, query: dict[str, Any] | None, next_block: int) -> None:
        self.query = query
        self.next_block = next_block


class NodeFilters:
    """The filters of one node (`eth_newFilter`, …): each returns what is new since the last request.

    `logs` answers a query as `eth_getLogs` does, and `bound` reads a bound of its range. All methods raise `RpcError`.
    """

    def __init__(
        self,
        evm: Evm,
        logs: Callable[[dict[str, Any]], list[dict[str, Any]]],
        bound: Callable[[object], int],
    ) -> None:
        self._evm = evm
        self._logs = logs
        self._bound = bound
        self._filters: OrderedDict[str, _Filter] = OrderedDict()
        self._made = 0

    def methods(self) -> dict[str, Callable[..., Any]]:
        """The JSON-RPC methods that use filters, by name."""
        return {
            "eth_newFilter": self.of_logs,
            "eth_newBlockFilter": self.of_blocks,
            "eth_getFilterChanges": self.changes,
            "eth_getFilterLogs": self.everything,
            "eth_uninstallFilter": self.remove,
        }

    def of_logs(self, query: object) -> str:
        """Add a filter for the logs that a query accepts; its id."""
        LogFilter(query)  # raises for an invalid query
        assert isinstance(query, dict)
        return self._add(query)

    def of_blocks(self) -> str:
        """Add a filter for the hashes of new blocks; its id."""
        return self._add(None)

    def changes(self, name: object) -> list[Any]:
        """What is new since the last request. The rest follows with the next one if it is much."""
        found = self._find(name)
        # The chain may have been reverted in the meantime.
        first = min(found.next_block, self._evm.head + 1)
        found.next_block = self._evm.head + 1
        if found.query is None:
            found.next_block = min(found.next_block, first + self._evm.max_logs)
            return [self._hash(number) for number in range(first, found.next_block)]
        if isinstance(found.query.get("fromBlock"), str) and found.query["fromBlock"].startswith("0x"):
            first = max(first, parse_quantity(found.query["fromBlock"]))
        wanted, last = LogFilter(found.query), self._bound(found.query.get("toBlock"))
        logs: list[dict[str, Any]] = []
        for log in self._evm.logs(first, last):
            if wanted.accepts(log):
                if len(logs) >= self._evm.max_logs and log["blockNumber"] != logs[-1]["blockNumber"]:
                    found.next_block = int(log["blockNumber"], 16)
                    break
                logs.append(log)
        return logs

    def everything(self, name: object) -> list[dict[str, Any]]:
        """All logs that a filter's query accepts."""
        query = self._find(name).query
        if query is None:
            raise RpcError(INVALID_PARAMS, "this filter is of blocks, not of logs")
        return self._logs(query)

    def remove(self, name: object) -> bool:
        """Remove a filter; False if there was none."""
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

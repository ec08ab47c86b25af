"""Nodes that are several machines of different ages, or that restrict `eth_getLogs`, as providers' nodes do.

Each is a transport in front of another, for `Node` and `Chain`.
"""

from __future__ import annotations

from typing import Any

UNKNOWN_BLOCK = {"code": -32000, "message": "unknown block"}
WANTS_ADDRESS = {"code": -32602, "message": "Please specify an address in your request"}
SWITCHED_OFF = {"code": -32601, "message": "the method eth_getLogs does not exist/is not available"}


class LaggingPool:
    """Requests for logs go to a machine that is `behind` by some blocks, all others to one at the head.

    For a block that it lacks it answers `[]`, or, with `knows_hashes`, an error if it is asked for by its hash. With
    `every`, only the first and then each second, third, … request for logs goes to it.
    """

    def __init__(self, node: Any, *, behind: int, knows_hashes: bool = False, every: int = 1) -> None:
        self.node, self.behind, self.knows_hashes = node, behind, knows_hashes
        self._every, self._asked = every, 0
        self.stale = 0
        """How many answers lacked something."""
        self.limit: int | None = None
        """How many answers may lack something, before the machine has caught up."""

    async def make_request(self, method: str, params: Any) -> Any:
        """The answer of one of the machines."""
        if method != "eth_getLogs" or (self.limit is not None and self.stale >= self.limit):
            return await self.node.make_request(method, params)
        self._asked += 1
        if (self._asked - 1) % self._every:
            return await self.node.make_request(method, params)
        query = dict(params[0])
        last = int((await self.node.make_request("eth_blockNumber", []))["result"], 16) - self.behind
        if "blockHash" in query:
            block = (await self.node.make_request("eth_getBlockByHash", [query["blockHash"], False]))["result"]
            if int(block["number"], 16) <= last:
                return await self.node.make_request(method, params)
            self.stale += 1
            return _error(UNKNOWN_BLOCK) if self.knows_hashes else {"jsonrpc": "2.0", "id": 1, "result": []}
        if int(query["toBlock"], 16) > last:
            self.stale += 1
            if int(query["fromBlock"], 16) > last:
                return {"jsonrpc": "2.0", "id": 1, "result": []}
            query["toBlock"] = hex(last)
        return await self.node.make_request(method, [query])

    def __str__(self) -> str:
        return "pool"


class LaggingCalls:
    """Calls of contracts go to a machine that is `behind` by some blocks, all other requests to one at the head.

    Its latest block is an earlier one, and it refuses to answer for a later one. What follows a refusal goes to the
    other machine.
    """

    def __init__(self, node: Any, *, behind: int) -> None:
        self.node, self.behind = node, behind
        self.refused = 0
        self._is_other_next = False

    async def make_request(self, method: str, params: Any) -> Any:
        """The answer of one of the machines."""
        if method not in ("eth_call", "eth_getCode"):
            return await self.node.make_request(method, params)
        last = int((await self.node.make_request("eth_blockNumber", []))["result"], 16) - self.behind
        is_other, self._is_other_next = self._is_other_next, False
        if params[1] == "latest" and not is_other:
            params = [params[0], hex(last)]
        elif int(params[1], 16) > last and not is_other:
            self.refused += 1
            self._is_other_next = True
            return _error({"code": -32000, "message": "header not found"})
        return await self.node.make_request(method, params)

    def __str__(self) -> str:
        return "calls of a pool"


class RestrictedLogs:
    """A node that wants an address in `eth_getLogs`, or, with `is_off`, has no such method."""

    def __init__(self, node: Any, *, is_off: bool = False, has_receipts: bool = True) -> None:
        self.node, self.is_off, self.has_receipts = node, is_off, has_receipts

    async def make_request(self, method: str, params: Any) -> Any:
        """The node's answer, or its refusal."""
        if method == "eth_getLogs" and self.is_off:
            return _error(SWITCHED_OFF)
        if method == "eth_getLogs" and not params[0].get("address"):
            return _error(WANTS_ADDRESS)
        if method in ("eth_getBlockByHash", "eth_getBlockReceipts") and not self.has_receipts:
            return _error({"code": -32601, "message": f"the method {method} does not exist/is not available"})
        return await self.node.make_request(method, params)

    def __str__(self) -> str:
        return "restricted"


def _error(error: dict[str, Any]) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": 1, "error": error}

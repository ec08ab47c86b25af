"""JSON-RPC for wallets and for the page: what only reads the chain, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridges.web.errors import InvalidRequest
from mesh.chain import RequestRefused, Reverted
from mesh.errors import ChainError

if TYPE_CHECKING:
    from mesh.chain import Node

METHODS: Final = frozenset(
    {
        "eth_blockNumber",
        "eth_call",
        "eth_chainId",
        "eth_estimateGas",
        "eth_feeHistory",
        "eth_gasPrice",
        "eth_getBalance",
        "eth_getBlockByNumber",
        "eth_getCode",
        "eth_getTransactionByHash",
        "eth_getTransactionCount",
        "eth_getTransactionReceipt",
        "eth_maxPriorityFeePerGas",
        "net_version",
    }
)
"""The methods that are passed on. None of them changes anything, and none reads a range of blocks."""
MOST_PARAMETERS: Final = 8
METHOD_NOT_FOUND: Final = -32601
SERVER_ERROR: Final = -32000
EXECUTION_REVERTED: Final = 3


class RpcRequest(msgspec.Struct, frozen=True):
    """A request of JSON-RPC 2.0."""

    method: str
    params: list[Any] = msgspec.field(default_factory=list)
    id: int | str | None = None
    jsonrpc: str = "2.0"


async def answer(node: Node, body: bytes) -> dict[str, Any]:
    """The response to a request. Raises `InvalidRequest` for what is none."""
    try:
        request = msgspec.json.decode(body, type=RpcRequest)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidRequest(f"not a request of JSON-RPC: {error}"[:200]) from None
    response: dict[str, Any] = {"jsonrpc": "2.0", "id": request.id}
    if request.method not in METHODS or len(request.params) > MOST_PARAMETERS:
        return response | {"error": {"code": METHOD_NOT_FOUND, "message": f"{request.method[:64]} is not passed on"}}
    try:
        return response | {"result": await node.request(request.method, *request.params)}
    except Reverted as error:
        code, data = EXECUTION_REVERTED, {"data": "0x" + error.data.hex()}
        return response | {"error": {"code": code, "message": str(error)} | data}
    except RequestRefused as error:
        return response | {"error": {"code": error.rpc_code, "message": error.detail}}
    except ChainError as error:
        return response | {"error": {"code": SERVER_ERROR, "message": str(error)}}

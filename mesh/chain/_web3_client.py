"""web3's client of an open chain: `chain.web3`. Nothing else imports web3, which takes half a second and 20 MB."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, cast

from eth_typing import ChecksumAddress, HexAddress, HexStr
from hexbytes import HexBytes
from web3 import AsyncWeb3
from web3.exceptions import ProviderConnectionError
from web3.middleware import Web3Middleware
from web3.providers.async_base import AsyncBaseProvider

from mesh.chain.answers import ANSWERS, RpcFailure
from mesh.errors import AiraError

if TYPE_CHECKING:
    from web3.types import AsyncMakeRequestFn, RPCEndpoint, RPCResponse

    from mesh.chain.rpc import RpcClient
    from mesh.chain.transactions import TransactionSender


def web3_of(rpc: RpcClient, sender: TransactionSender | None) -> AsyncWeb3[AsyncBaseProvider]:
    """web3's client whose requests are those of `rpc`, and whose transactions are sent by `sender`."""
    client: AsyncWeb3[AsyncBaseProvider] = AsyncWeb3(_Provider(rpc))
    if sender is not None:
        client.eth.default_account = ChecksumAddress(HexAddress(HexStr(sender.account.address)))
        client.middleware_onion.add(partial(_Sending, sender))  # type: ignore[arg-type]
    return client


class _Provider(AsyncBaseProvider):
    """Several endpoints, quotas, limits on answers and their check: those of every request."""

    def __init__(self, rpc: RpcClient) -> None:
        super().__init__()
        self._rpc = rpc

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        """A node's response, which may be an error. Raises as `RpcClient.request` does, but for errors of the node."""
        # What web3 asks of blocks may hold whole transactions, or blocks that are not mined.
        kind = Any if method.startswith("eth_getBlock") else ANSWERS.get(method, Any)
        response, answer = await self._rpc.answered(method, params, kind)
        if isinstance(answer, RpcFailure):
            response = {"error": {"code": answer.code, "message": answer.message, "data": answer.data}}
        return cast("RPCResponse", {"jsonrpc": "2.0", "id": 0, **response})

    async def is_connected(self, show_traceback: bool = False) -> bool:
        """Whether a node answers."""
        try:
            await self._rpc.request("eth_chainId", [])
        except AiraError as error:
            if show_traceback:
                raise ProviderConnectionError(str(error)) from error
            return False
        return True


class _Sending(Web3Middleware):
    """Transactions of web3's client, sent as all others of the account."""

    def __init__(self, sender: TransactionSender, w3: AsyncWeb3[AsyncBaseProvider]) -> None:
        super().__init__(w3)
        self._sender = sender

    async def async_wrap_make_request(self, make_request: AsyncMakeRequestFn) -> AsyncMakeRequestFn:
        async def request(method: RPCEndpoint, params: Any) -> RPCResponse:
            given = params[0] if method == "eth_sendTransaction" else {}
            if given.get("from") != self._sender.account.address:
                return await make_request(method, params)
            receipt = await self._sender.send(
                to=given.get("to") or None,
                data=bytes(HexBytes(given.get("data", b""))),
                value=int.from_bytes(HexBytes(given.get("value", 0))),
            )
            return {"jsonrpc": "2.0", "id": 0, "result": receipt.tx}

        return request

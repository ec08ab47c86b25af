"""web3 on the embedded chain, as an independent client."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from web3 import AsyncWeb3
from web3.providers.async_base import AsyncBaseProvider

if TYPE_CHECKING:
    from web3.types import RPCEndpoint, RPCResponse

    from mesh.dev._embedded import EmbeddedChain


class _InProcess(AsyncBaseProvider):
    def __init__(self, node: EmbeddedChain) -> None:
        super().__init__()
        self._node = node

    async def make_request(self, method: RPCEndpoint, params: Any) -> RPCResponse:
        response: Any = await self._node.provider.make_request(method, params)
        return response  # type: ignore[no-any-return]


def web3_of(node: EmbeddedChain) -> AsyncWeb3[Any]:
    """A client whose requests go to the chain in this process."""
    return AsyncWeb3(_InProcess(node))

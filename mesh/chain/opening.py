"""A chain opened: its node, its names, the contracts behind them, and who signs."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from mesh.chain.errors import NoAccount, NoContracts, UnknownName
from mesh.chain.names import Names, find_registry
from mesh.chain.node import Node
from mesh.chain.suites import Kind, Suite, open_suite
from mesh.chain.transactions import Receipt, Sender
from mesh.errors import ClosedError

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from web3.contract import AsyncContract
    from web3.contract.async_contract import AsyncContractFunction

    from mesh.chain.accounts import Account
    from mesh.chain.fees import FeePolicy
    from mesh.chain.provider import Endpoint
    from mesh.chain.timing import Timing


class OpenChain:
    """What `Chain` stands on; see there."""

    def __init__(
        self,
        endpoint: Endpoint | Node,
        *,
        account: Account | None = None,
        ens: str = "",
        factory: str = "",
        xrt: str = "",
        generation: int = 3,
        contracts: Kind = "mesh",
        timing: Timing | None = None,
        fees: FeePolicy | None = None,
        journal: Path | None = None,
    ) -> None:
        self.account = account
        self._is_given_node = isinstance(endpoint, Node)
        self.node = (
            endpoint if isinstance(endpoint, Node) else Node(endpoint, timing=timing, fees=fees, journal=journal)
        )
        self.generation = generation
        self._ens = ens
        self._factory_name = factory or f"factory.{generation}.robonomics.eth"
        self._xrt_name = xrt or f"xrt.{generation}.robonomics.eth"
        self._stack = AsyncExitStack()
        self._names: Names | None = None
        self._factory = self._xrt = ""
        self._kind = contracts
        self._opened_suite: Suite | None = None
        self._sender = None if account is None else Sender(self.node, account)

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            if not self._is_given_node:
                await stack.enter_async_context(self.node)
            self._names = Names(self.node, await find_registry(self.node, self._ens))
            try:
                self._factory = await self._names.address(self._factory_name)
                self._xrt = await self._names.address(self._xrt_name)
            except UnknownName as error:
                raise NoContracts(f"contract named {error.name}", self.node.chain_id) from None
            if not await self.node.web3.eth.get_code(self.node.checksum(self._factory)):
                raise NoContracts(f"factory at {self._factory}", self.node.chain_id)
            self._opened_suite = open_suite(self._kind, self.node, self._factory, self.generation)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._names = self._opened_suite = None
        await self._stack.aclose()

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain."""
        return self.node.chain_id

    @property
    def ens(self) -> str:
        """Address of the ENS registry in use."""
        return self._opened().registry

    @property
    def factory(self) -> str:
        """Address of the factory, which is also what `approve` names as the spender for costs and fees."""
        self._opened()
        return self._factory

    @property
    def xrt(self) -> str:
        """Address of the token XRT."""
        self._opened()
        return self._xrt

    async def block_number(self) -> int:
        """Number of the latest block."""
        return await self.node.block_number()

    async def resolve(self, name_or_address: str) -> str:
        """The address behind an ENS name, or the address itself.

        Raises `InvalidName`, `InvalidAddress`, `UnknownName`.
        """
        return await self._opened().address(name_or_address)

    async def resolve_model(self, name_or_cid: str) -> str:
        """The CID behind a model's ENS name, or the CID itself. Raises `InvalidCid`, `UnknownName`."""
        return await self._opened().model(name_or_cid)

    async def lighthouse_address(self, name: str) -> str:
        """The address of a lighthouse; a label alone (`airalab`) is taken under the generation's root."""
        is_label = "." not in name and not name.startswith("0x")
        return await self.resolve(f"{name}.lighthouse.{self.generation}.robonomics.eth" if is_label else name)

    def _opened(self) -> Names:
        if self._names is None:
            raise ClosedError("the chain is not open: use it with `async with`")
        return self._names

    @property
    def _suite(self) -> Suite:
        self._opened()
        assert self._opened_suite is not None
        return self._opened_suite

    def _factory_contract(self) -> AsyncContract:
        return self.node.contract("Factory", self.factory)

    async def _lighthouse(self, lighthouse: str) -> AsyncContract:
        return self.node.contract("Lighthouse", await self.lighthouse_address(lighthouse))

    async def _token(self, token: str | None) -> AsyncContract:
        return self.node.contract("XRT", self.xrt if token is None else await self.resolve(token))

    async def _whose(self, address: str | None) -> str:
        return self._signing().account.address if address is None else await self.resolve(address)

    async def _send(self, function: AsyncContractFunction) -> Receipt:
        return await self._signing().call(function)

    def _signing(self) -> Sender:
        if self._sender is None:
            raise NoAccount
        self._opened()
        return self._sender

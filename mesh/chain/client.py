"""The chain as the mesh uses it: names, tokens, liabilities, lighthouses, events; one account that signs."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from mesh.chain.errors import NoAccount, NoContracts, UnknownName
from mesh.chain.events import liability_created, lighthouse_created
from mesh.chain.names import Names, find_registry
from mesh.chain.node import Node
from mesh.chain.reader import BlockEvents, Sources, find_lighthouses, read_blocks
from mesh.chain.records import Created, LighthouseState, Settled, is_liability, read_liability, read_lighthouse
from mesh.chain.transactions import Receipt, Sender
from mesh.errors import ClosedError
from schemas.cid import parse_cid
from schemas.packing import order_abi

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterable
    from types import TracebackType
    from typing import Self

    from web3.contract import AsyncContract
    from web3.contract.async_contract import AsyncContractFunction
    from web3.providers.async_base import AsyncBaseProvider

    from mesh.chain.accounts import Account
    from mesh.chain.events import NewLighthouse
    from mesh.chain.history import History
    from mesh.chain.timing import Timing
    from schemas.liability import Liability
    from schemas.messages import Demand, Offer, Result


class Chain:
    """The contracts of the network on the chain at `endpoint` (see `Node`), for one `account` or for reading only.

    `ens` is the address of the ENS registry (empty: the public or a development chain's); `factory` and `xrt` are
    names or addresses. Amounts are ints: wei for ETH, wn for XRT, a token's smallest unit otherwise. Addresses are
    EIP-55; where a lighthouse, token or account is asked for, an ENS name does as well.

    Used with `async with`, which raises `NodeUnreachable`, `NoContracts` and `UnknownName`. Every method raises
    `NodeUnreachable` when the node is lost. What sends a transaction waits until it is mined and raises `NoAccount`,
    `Reverted` (also without sending, when the simulation fails), `InsufficientFunds`, `TransactionTimeout`.
    """

    def __init__(
        self,
        endpoint: str | AsyncBaseProvider | Node,
        *,
        account: Account | None = None,
        ens: str = "",
        factory: str = "factory.3.robonomics.eth",
        xrt: str = "xrt.3.robonomics.eth",
        timing: Timing | None = None,
    ) -> None:
        self.account = account
        self._given_node = endpoint if isinstance(endpoint, Node) else None
        self.node = endpoint if isinstance(endpoint, Node) else Node(endpoint, timing=timing)
        self._ens, self._factory_name, self._xrt_name = ens, factory, xrt
        self._stack = AsyncExitStack()
        self._names: Names | None = None
        self._factory = self._xrt = ""
        self._sender = None if account is None else Sender(self.node, account)
        self._liabilities: set[str] = set()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            if self._given_node is None:
                await stack.enter_async_context(self.node)
            self._names = Names(self.node, await find_registry(self.node, self._ens))
            try:
                self._factory = await self._names.address(self._factory_name)
                self._xrt = await self._names.address(self._xrt_name)
            except UnknownName as error:
                raise NoContracts(f"contract named {error.name}", self.node.chain_id) from None
            if not await self.node.web3.eth.get_code(self.node.checksum(self._factory)):
                raise NoContracts(f"factory at {self._factory}", self.node.chain_id)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._names = None
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

    async def eth_balance(self, address: str | None = None) -> int:
        """Wei of an account; of one's own by default."""
        return await self.node.eth_balance(await self._whose(address))

    async def balance_of(self, address: str | None = None, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that an account holds."""
        contract = await self._token(token)
        return int(await self.node.read(contract.functions.balanceOf(await self._whose(address))))

    async def allowance(self, owner: str, spender: str, *, token: str | None = None) -> int:
        """Units of a token (XRT by default) that `spender` may take from `owner`."""
        functions = (await self._token(token)).functions
        return int(await self.node.read(functions.allowance(await self.resolve(owner), await self.resolve(spender))))

    async def approve(self, spender: str, value: int, *, token: str | None = None) -> str:
        """Let `spender` take up to `value` units of a token (XRT by default); the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.approve(await self.resolve(spender), value))).tx

    async def transfer(self, to: str, value: int, *, token: str | None = None) -> str:
        """Send units of a token (XRT by default); the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.transfer(await self.resolve(to), value))).tx

    async def transfer_from(self, owner: str, to: str, value: int, *, token: str | None = None) -> str:
        """Send what `owner` approved for this account; the transaction's hash."""
        functions = (await self._token(token)).functions
        return (await self._send(functions.transferFrom(await self.resolve(owner), await self.resolve(to), value))).tx

    async def send_eth(self, to: str, value: int) -> str:
        """Send `value` wei; the transaction's hash."""
        return (await self._signing().send(to=await self.resolve(to), data=b"", value=value)).tx

    async def nonce_of(self, address: str | None = None) -> int:
        """The nonce that an account's next generation-5 order must have."""
        functions = self._factory_contract().functions
        return int(await self.node.read(functions.nonceOf(await self._whose(address))))

    async def is_order_used(self, order_hash: bytes) -> bool:
        """Whether a generation-3 order was used already (generation 5 is told by its nonce)."""
        return bool(await self.node.read(self._factory_contract().functions.isHashConsumed(order_hash)))

    async def liability(self, address: str) -> Liability:
        """The record of a liability. Raises `NotALiability` unless the factory made it."""
        return await read_liability(self.node, self.factory, await self.resolve(address))

    async def order_hashes(self, liability: str) -> tuple[bytes, bytes]:
        """The hashes of the demand and of the offer that a liability was made of."""
        functions = self.node.contract("Liability", liability).functions
        demand_hash = await self.node.read(functions.demandHash())
        return bytes(demand_hash), bytes(await self.node.read(functions.offerHash()))

    async def is_liability(self, address: str) -> bool:
        """Whether the factory made the contract at an address."""
        if address not in self._liabilities and await is_liability(self.node, self.factory, address):
            self._liabilities.add(address)
        return address in self._liabilities

    async def create_liability(self, lighthouse: str, demand: Demand, offer: Offer) -> Created:
        """Make a liability of two signed orders, as a provider of the lighthouse.

        Raises `InvalidMessage` for an unsigned order or one with a name that is not resolved.
        """
        functions = (await self._lighthouse(lighthouse)).functions
        receipt = await self._send(functions.createLiability(order_abi(demand), order_abi(offer)))
        return Created(liability_created(receipt.logs).liability, receipt.tx, receipt.gas_used)

    async def finalize(self, lighthouse: str, result: Result) -> Settled:
        """Finalize a liability by its signed result, as a provider of the lighthouse."""
        function = (await self._lighthouse(lighthouse)).functions.finalizeLiability
        receipt = await self._send(function(result.liability, *_result_arguments(result)))
        return Settled(receipt.tx, receipt.gas_used)

    async def validate(self, result: Result, *, agree: bool) -> Settled:
        """Finalize a generation-3 liability as the validator that it names.

        Without `agree` the promisee is paid back, as for a result without success.
        """
        function = self.node.contract("Liability", result.liability).functions.finalize
        receipt = await self._send(function(*_result_arguments(result), agree))
        return Settled(receipt.tx, receipt.gas_used)

    async def refundable_from(self, liability: str) -> int:
        """The block from which anyone may have the promisee paid back, if the liability is not finalized by then."""
        return int(await self.node.read(self.node.contract("Liability", liability).functions.refundableFrom()))

    async def refund(self, liability: str) -> Settled:
        """Pay back the promisee of a liability that was never finalized."""
        receipt = await self._send(self._factory_contract().functions.refund(liability))
        return Settled(receipt.tx, receipt.gas_used)

    async def lighthouse_address(self, name: str) -> str:
        """The address of a lighthouse; a label alone (`airalab`) is taken under generation 3's root."""
        is_label = "." not in name and not name.startswith("0x")
        return await self.resolve(f"{name}.lighthouse.3.robonomics.eth" if is_label else name)

    async def lighthouse(self, lighthouse: str) -> LighthouseState:
        """The state of a lighthouse: stakes, turn, quota."""
        return await read_lighthouse(self.node, await self.lighthouse_address(lighthouse))

    async def is_turn(self, lighthouse: str, address: str | None = None) -> bool:
        """Whether a provider (one's own account by default) may send to a lighthouse in the next block."""
        function = (await self._lighthouse(lighthouse)).functions.isTurnOf
        return bool(await self.node.read(function(await self._whose(address)), block="pending"))

    async def lighthouses(self, *, from_block: int = 0) -> list[NewLighthouse]:
        """All lighthouses made since a block, in order."""
        return await find_lighthouses(self.node, self._sources(()), from_block)

    async def create_lighthouse(self, *, minimal_stake: int, timeout_blocks: int, name: str) -> NewLighthouse:
        """Make a market. `minimal_stake` in wn; `name` is one label of a to z, 0 to 9 and -."""
        function = self._factory_contract().functions.createLighthouse
        return lighthouse_created((await self._send(function(minimal_stake, timeout_blocks, name))).logs)

    async def refill(self, lighthouse: str, value: int) -> str:
        """Stake `value` wn, for which the lighthouse must be approved, and become a provider; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.refill(value))).tx

    async def withdraw(self, lighthouse: str, value: int) -> str:
        """Take `value` wn off the stake, or all of it where less than the minimum would remain; the tx hash."""
        return (await self._send((await self._lighthouse(lighthouse)).functions.withdraw(value))).tx

    def events(
        self, from_block: int, *, lighthouses: Iterable[str] = (), history: History | None = None
    ) -> AsyncGenerator[BlockEvents, None]:
        """Events from a block on, for ever (see `read_blocks`); those of lighthouses only of the given addresses.

        Blocks that the chain replaced are told as `Reorganised`, also from before where the `history` is given that
        an earlier iterator filled.
        """
        return read_blocks(self.node, self._sources(lighthouses), from_block, history=history)

    def _sources(self, lighthouses: Iterable[str]) -> Sources:
        return Sources(
            factory=self.factory, xrt=self.xrt, lighthouses=tuple(lighthouses), is_liability=self.is_liability
        )

    def _opened(self) -> Names:
        if self._names is None:
            raise ClosedError("the chain is not open: use it with `async with`")
        return self._names

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


def _result_arguments(result: Result) -> tuple[bytes, bool, bytes]:
    return parse_cid(result.result), result.success, bytes.fromhex(result.signature)

"""`Chain`: liabilities, lighthouses, tokens, names and events of one chain, for one account."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar, Unpack

from mesh.base.lifecycle import Lifecycle
from mesh.chain._abi import is_code_of
from mesh.chain._contracts import ContractNames, Contracts, contract_version
from mesh.chain._lighthouses import Lighthouses
from mesh.chain._names import Names, find_registry
from mesh.chain._node import Node
from mesh.chain._permits import Permits
from mesh.chain._tokens import Funds, Tokens
from mesh.chain._validators import Validators
from mesh.chain.errors import NoContracts, UnknownName
from mesh.chain.following import NODE_ERRORS, EventSources, follow, glance, read_events, retrying
from mesh.chain.liabilities import Liabilities
from mesh.chain.transactions import TransactionSender
from mesh.settings.chains import ANY
from mesh.telemetry.metrics import gauge
from mesh.telemetry.serving import CachedMetrics

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
    from contextlib import AsyncExitStack
    from pathlib import Path

    from web3 import AsyncWeb3
    from web3.providers.async_base import AsyncBaseProvider

    from mesh.base.outage_log import OutageLog
    from mesh.chain._accounts import Account
    from mesh.chain._node import FeePolicy, Timing
    from mesh.chain.following import BlockEvents, History, Selection
    from mesh.chain.rpc import Endpoint
    from mesh.errors import AiraError
    from mesh.settings.chains import ChainProfile
    from mesh.telemetry.metrics import MetricFamily

T = TypeVar("T")


class Chain(Lifecycle):
    """The contracts of the network on the chain at `endpoint` (see `Node`), for one `account` or for reading only.

    `timing`, `fees`, `transactions` and `profile` are for the node (see `Node`), unless a node is given.

    Amounts are ints: wei for ETH, wn for XRT, a token's smallest unit otherwise. Addresses are EIP-55; an ENS name
    works wherever a lighthouse, token or account is expected.

    Used with `async with`, which raises `NodeUnreachable`, `NoContracts` and `UnknownName`. Every method raises
    `NodeUnreachable` when the node is lost, except those that wait for something. Methods that send a transaction wait
    until it is mined; they raise `Reverted` (also without sending, when the simulation fails), `InsufficientFunds`,
    `TransactionTimeout`, and `ConfigurationError` (`no-account`). Its methods are grouped in parts: `liabilities`,
    `lighthouses`, `validators`, `funds`, `tokens`, `names`; `follow` yields events; `web3` talks to any other
    contract.
    """

    title = "chain"

    def __init__(
        self,
        endpoint: Endpoint | Node,
        *,
        account: Account | None = None,
        contracts: ContractNames = ContractNames(),  # noqa: B008
        timing: Timing | None = None,
        fees: FeePolicy | None = None,
        transactions: Path | None = None,
        profile: ChainProfile = ANY,
    ) -> None:
        self.account = account
        self.generation: Final = contracts.generation
        self._owns_node = not isinstance(endpoint, Node)
        self.node = (
            endpoint
            if isinstance(endpoint, Node)
            else Node(endpoint, timing=timing, fees=fees, transactions=transactions, profile=profile)
        )
        self._contract_names = contracts
        self._web3: AsyncWeb3[AsyncBaseProvider] | None = None
        self._balances = CachedMetrics(self._ask_balances, max_age=self.node.timing.metrics_age)

    async def _open(self, stack: AsyncExitStack) -> None:
        if self._owns_node:
            await stack.enter_async_context(self.node)
        self._contracts = contracts = await self._find_contracts()
        self._web3 = None
        self._permits, self._tokens = Permits(contracts), Tokens(contracts)
        self._funds = Funds(contracts, self._permits)
        self._validators = Validators(contracts, listed=self._contract_names.validators)

    @property
    def chain_id(self) -> int:
        """EIP-155 number of the chain."""
        return self.node.chain_id

    @property
    def ens(self) -> str:
        """Address of the ENS registry in use."""
        return self._opened().names.registry

    @property
    def factory(self) -> str:
        """Address of the factory, which is the spender to approve for costs and fees."""
        return self._opened().factory

    @property
    def xrt(self) -> str:
        """Address of the token XRT."""
        return self._opened().xrt

    @property
    def names(self) -> Names:
        """ENS names."""
        return self._opened().names

    @property
    def tokens(self) -> Tokens:
        """Ether, XRT and other tokens."""
        self.check_open()
        return self._tokens

    @property
    def funds(self) -> Funds:
        """What accounts have and let the factory take; what orders cost, and whether it can be paid."""
        self.check_open()
        return self._funds

    @property
    def permits(self) -> Permits:
        """Approvals by signature (EIP-2612): the account's own, and those of others that were noted."""
        self.check_open()
        return self._permits

    @property
    def lighthouses(self) -> Lighthouses:
        """Lighthouses, stakes and turns."""
        return Lighthouses(self._opened())

    @property
    def liabilities(self) -> Liabilities:
        """Liabilities, and the orders that they are created from."""
        return Liabilities(self._opened())

    @property
    def validators(self) -> Validators:
        """Which validators orders may name."""
        self.check_open()
        return self._validators

    @property
    def web3(self) -> AsyncWeb3[AsyncBaseProvider]:
        """web3's client of the same nodes, to talk to any other contract: `chain.web3.eth.contract(…)`.

        Its requests are repeated, limited and checked as all others here. With an account, that is its
        `eth.default_account`, and what `transact` and `eth.send_transaction` send is priced, numbered, signed and sent
        again as every transaction of the account: they return when it is mined, and raise as `TransactionSender.send`
        does, whatever gas and fees they were given. web3 looks names up in the public network's ENS only:
        `chain.names` knows this chain's.
        """
        contracts = self._opened()
        if self._web3 is None:
            from mesh.chain._web3_client import web3_of  # takes 20 MB, which few programs need

            self._web3 = web3_of(self.node.rpc, contracts.sender)
        return self._web3

    async def has_mesh_contracts(self) -> bool:
        """Whether factory and token have the code that this project's sources compile to."""
        for name, address in (("Factory", self.factory), ("XRT", self.xrt)):
            if not is_code_of(name, await self.node.code(address)):
                return False
        return True

    async def block_number(self) -> int:
        """Number of the latest block."""
        return await self.node.block_number()

    async def contract_block(self) -> int:
        """The contracts' number of the latest block, which deadlines and refunds count: on Arbitrum, Ethereum's."""
        return await self.node.contract_block()

    def follow(
        self,
        cursor: int,
        *,
        history: History | None = None,
        outages: OutageLog | None = None,
        **selection: Unpack[Selection],
    ) -> AsyncGenerator[BlockEvents, None]:
        """Blocks with their events from the block `cursor` on, and reorganisations, without end: see `following`.

        The events are those of the `Selection`: its `token`, `parties` and `choose`. Outages of the node are logged to
        `outages` and survived. Raises `ChainWentBack`.
        """
        sources = EventSources.of(self._opened(), selection)
        read = partial(read_events, self.node, sources)
        look = None if sources.parties is None else partial(glance, self.node, sources)
        return follow(self.node, read, cursor, look=look, history=history, outages=outages)

    async def retrying(
        self,
        question: Callable[[], Awaitable[T]],
        *,
        outages: OutageLog | None = None,
        errors: tuple[type[AiraError], ...] = NODE_ERRORS,
    ) -> T:
        """The answer to a question to the chain: see `following.retrying`."""
        return await retrying(self.node, question, outages=outages, errors=errors)

    async def measure(self) -> tuple[MetricFamily, ...]:
        """The metrics of the node, and of the account if there is one."""
        return (*self.node.families(), *await self._balances.measure())

    async def _ask_balances(self) -> Iterable[MetricFamily]:
        if self.account is None:
            return ()
        eth, xrt = await asyncio.gather(self.tokens.eth_balance(), self.tokens.balance())
        return (
            gauge("aira_account_eth_wei", "What the account has to pay gas with, wei", eth),
            gauge("aira_account_xrt_wn", "What the account has of XRT, wn", xrt),
        )

    async def _find_contracts(self) -> Contracts:
        meant, generation = self._contract_names, self.generation
        names = Names(self.node, await find_registry(self.node, meant.ens), generation)
        try:
            factory = await names.address(meant.factory or f"factory.{generation}.robonomics.eth")
            xrt = await names.address(meant.xrt or f"xrt.{generation}.robonomics.eth")
        except UnknownName as error:
            raise NoContracts(f"contract named {error.name}", self.node.chain_id) from None
        if not await self.node.code(factory):
            raise NoContracts(f"factory at {factory}", self.node.chain_id)
        return Contracts(
            node=self.node,
            names=names,
            version=contract_version(meant.kind, self.node, factory, self.generation),
            factory=factory,
            xrt=xrt,
            sender=None if self.account is None else TransactionSender(self.node, self.account),
        )

    def _opened(self) -> Contracts:
        self.check_open()
        return self._contracts

"""Deploying the contracts: names, token, factory, and the first lighthouse."""

from __future__ import annotations

from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.chain.events import lighthouse_created
from mesh.chain.names import GENERATIONS, namehash
from mesh.chain.node import Node
from mesh.chain.transactions import TransactionSender
from schemas import keccak256

if TYPE_CHECKING:
    from mesh.chain.abi import ContractCall, ContractFunctions
    from mesh.chain.accounts import Account
    from mesh.chain.rpc_client import Endpoint
    from mesh.chain.transactions import Receipt

WN: Final = 1
XRT: Final = 10**9 * WN
"""One XRT in wn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeploymentPlan:
    """The parameters of a deployment. Amounts are wn (10^-9 XRT), times are blocks."""

    lighthouse: str = "airalab"
    """Label of the first lighthouse: `airalab.lighthouse.N.robonomics.eth`."""

    initial_supply: int = 1_000_000 * XRT
    """XRT of the deployer; all other XRT is minted for work."""

    minimal_stake: int = 1 * XRT
    """The least stake of a provider; each such amount is one transaction per turn."""

    timeout_blocks: int = 25
    """How long the current provider may be silent before another takes the turn."""

    refund_delay: int = 50_400
    """From the creation of a liability until it can be refunded (a week of 12-second blocks)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Deployment:
    """The deployed addresses (EIP-55), the number of the last block, and the gas of all transactions."""

    ens: str
    resolver: str
    xrt: str
    factory: str
    lighthouse: str
    lighthouse_name: str
    block_number: int
    gas_used: int


async def deploy(
    endpoint: Endpoint | Node,
    account: Account,
    *,
    plan: DeploymentPlan | None = None,
) -> Deployment:
    """Deploy everything with one account, which then owns the names and holds the initial supply.

    About twenty transactions, one after another. Raises `NodeUnreachable`, `InsufficientFunds`, `Reverted`.
    """
    async with AsyncExitStack() as stack:
        node = endpoint if isinstance(endpoint, Node) else await stack.enter_async_context(Node(endpoint))
        return await _Deployer(node, account, plan or DeploymentPlan()).run()


class _Deployer:
    """The steps of a deployment, each of which needs the ones before."""

    def __init__(self, node: Node, account: Account, plan: DeploymentPlan) -> None:
        self._node = node
        self._sender = TransactionSender(node, account)
        self._owner = account.address
        self._plan = plan
        self._gas_used = 0

    async def run(self) -> Deployment:
        plan = self._plan
        ens = await self._create("ENSRegistry")
        resolver = await self._create("Resolver", ens)
        xrt = await self._create("XRT", plan.initial_supply)
        factory = await self._create("Factory", ens, xrt, plan.refund_delay)
        await self._call(self._node.contract("XRT", xrt).setMinter(factory))
        await self._name(self._node.contract("ENSRegistry", ens), resolver, xrt=xrt, factory=factory)
        create = self._node.contract("Factory", factory).createLighthouse
        receipt = await self._call(create(plan.minimal_stake, plan.timeout_blocks, plan.lighthouse))
        return Deployment(
            ens=ens,
            resolver=resolver,
            xrt=xrt,
            factory=factory,
            lighthouse=lighthouse_created(receipt.logs).lighthouse,
            lighthouse_name=f"{plan.lighthouse}.lighthouse.{GENERATIONS[0]}.robonomics.eth",
            block_number=receipt.block_number,
            gas_used=self._gas_used,
        )

    async def _create(self, name: str, *arguments: Any) -> str:
        receipt = await self._sender.send(to=None, data=self._node.creation_code(name, *arguments))
        assert receipt.contract is not None
        self._gas_used += receipt.gas_used
        return receipt.contract

    async def _call(self, call: ContractCall) -> Receipt:
        receipt = await self._sender.call(call)
        self._gas_used += receipt.gas_used
        return receipt

    async def _name(self, registry: ContractFunctions, resolver: str, *, xrt: str, factory: str) -> None:
        """Name the contracts under the roots of both generations; the factory names the lighthouses."""
        set_record = registry.setSubnodeRecord
        set_address = self._node.contract("Resolver", resolver).setAddr

        async def own(parent: str, label: str, owner: str) -> None:
            await self._call(set_record(namehash(parent), keccak256(label.encode()), owner, resolver, 0))

        await own("", "eth", self._owner)
        await own("eth", "robonomics", self._owner)
        for generation in GENERATIONS:
            root = f"{generation}.robonomics.eth"
            await own("robonomics.eth", str(generation), self._owner)
            await own(root, "lighthouse", factory)
            await own(root, "model", self._owner)
            for label, address in (("xrt", xrt), ("factory", factory)):
                await own(root, label, self._owner)
                await self._call(set_address(namehash(f"{label}.{root}"), address))

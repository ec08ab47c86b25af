"""Deploying the contracts: names, token, factory, and the first lighthouse."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.chain._abi import is_code_of
from mesh.chain._accounts import created_address
from mesh.chain._contracts import ContractNames
from mesh.chain._names import GENERATIONS, namehash
from mesh.chain._node import Node
from mesh.chain.errors import RequestRefused, Reverted
from mesh.chain.following import NewLighthouse, first_event
from mesh.chain.transactions import TransactionSender
from mesh.errors import ChainError
from schemas import keccak256
from schemas.address import ZERO_ADDRESS, address_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.chain._abi import ContractCall, ContractFunctions
    from mesh.chain._accounts import Account
    from mesh.chain.rpc import Endpoint
    from mesh.chain.transactions import Receipt

XRT: Final = 10**9
"""One XRT in wn."""

CANCUN_CODE: Final = "0x5f5f5f5e60015f5260205ff3"
"""Code that returns 1 where the EVM has PUSH0 and MCOPY, which the contracts use, and fails elsewhere."""

OLD_CODE: Final = "0x600160005260206000f3"
"""The same for any EVM: where it fails too, the node does not run code that is not deployed, and nothing is known."""


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
    emission_percent: int = 100
    """wn that providers are minted for 100 units of gas; more after a fork that makes the same work take more gas."""


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

    @property
    def contracts(self) -> ContractNames:
        """What a `Chain` needs to know of it."""
        return ContractNames(ens=self.ens)


async def deploy(
    endpoint: Endpoint | Node,
    account: Account,
    *,
    plan: DeploymentPlan | None = None,
) -> Deployment:
    """Deploy everything with one account, which then owns the names and holds the initial supply.

    About twenty transactions, one after another. One that was interrupted is continued: what the account has deployed
    and named by the same plan stays, and `gas_used` is that of the rest. Raises `ChainError` (`evm-too-old`:
    nothing is sent), `NodeUnreachable`, `InsufficientFunds`, `Reverted`.
    """
    async with AsyncExitStack() as stack:
        node = endpoint if isinstance(endpoint, Node) else await stack.enter_async_context(Node(endpoint))
        await check_evm(node)
        plan = plan or DeploymentPlan()
        return await _Deployer(node, account, plan, await interrupted_deployment(node, account.address, plan)).run()


async def check_evm(node: Node) -> None:
    """Raise `ChainError` (`evm-too-old`) if the chain can't run the contracts, which are compiled for Cancun."""
    if not await _returns_one(node, CANCUN_CODE) and await _returns_one(node, OLD_CODE):
        raise ChainError(
            f"the chain {node.chain_id} can't run the contracts: "
            "its EVM is older than Cancun (it lacks PUSH0 or MCOPY)",
            hint="deploy to a chain that has had the Cancun upgrade; start a development node with a later hardfork",
            code="evm-too-old",
        )


async def _returns_one(node: Node, code: str) -> bool:
    try:
        return int.from_bytes(await node.call({"data": code})) == 1
    except (RequestRefused, Reverted):
        return False


async def interrupted_deployment(node: Node, owner: str, plan: DeploymentPlan) -> dict[str, str]:
    """The addresses of what an account deployed by a plan without getting to its end, by the contracts' names.

    Nothing if it did, or deployed nothing among its last transactions.
    """
    newest = await _mined_count(node, owner) - 1
    found: dict[str, str] = {}
    for nonce in range(newest, max(newest - 40, -1), -1):  # a deployment has 22
        address = created_address(owner, nonce)
        code = await node.code(address)
        name = next((name for name in ("Factory", "XRT", "Resolver", "ENSRegistry") if is_code_of(name, code)), None)
        if name == "Factory" and await node.transaction_count(address) > 3:  # it has made more than its two templates
            return {}
        if name is not None and name not in found:
            found[name] = address
        if name == "ENSRegistry":
            return await _fitting(node, owner, plan, found)
    return {}


async def _mined_count(node: Node, owner: str) -> int:
    """An account's mined transactions, once those that wait are too: they may belong to an interrupted deployment."""
    until = time.monotonic() + node.timing.receipt_timeout
    while True:
        waiting = await node.transaction_count(owner, block="pending")
        mined = await node.transaction_count(owner)
        if mined >= waiting or time.monotonic() >= until:
            return mined
        await asyncio.sleep(node.timing.poll_interval)


async def _fitting(node: Node, owner: str, plan: DeploymentPlan, found: Mapping[str, str]) -> dict[str, str]:
    """Those of the contracts that the plan would deploy in the same way."""
    ens, fits = found["ENSRegistry"], dict(found)
    if await node.read(node.contract("ENSRegistry", ens).owner(bytes(32))) != owner:
        return {}
    if "Resolver" in fits and address_bytes(ens) not in await node.code(fits["Resolver"]):
        del fits["Resolver"]
    if "XRT" in fits:
        supply = node.contract("XRT", fits["XRT"]).totalSupply()
        minter = await node.read(node.contract("XRT", fits["XRT"]).minter())
        if await node.read(supply) != plan.initial_supply or minter not in (ZERO_ADDRESS, fits.get("Factory")):
            del fits["XRT"]
    if "Factory" in fits:
        factory = node.contract("Factory", fits["Factory"])
        calls = factory.ens(), factory.xrt(), factory.refundDelay(), factory.wnFor100Gas()
        has = [await node.read(call) for call in calls]
        if has != [ens, fits.get("XRT"), plan.refund_delay, plan.emission_percent]:
            del fits["Factory"]
    return fits


class _Deployer:
    """The steps of a deployment, each of which needs the ones before.

    `found` are the contracts of an interrupted one: then each step is done only if it was not.
    """

    def __init__(self, node: Node, account: Account, plan: DeploymentPlan, found: Mapping[str, str]) -> None:
        self._node = node
        self._sender = TransactionSender(node, account)
        self._owner = account.address
        self._plan = plan
        self._found = found
        self._gas_used = 0

    async def run(self) -> Deployment:
        plan = self._plan
        ens = await self._create("ENSRegistry")
        resolver = await self._create("Resolver", ens)
        xrt = await self._create("XRT", plan.initial_supply)
        factory = await self._create("Factory", ens, xrt, plan.refund_delay, plan.emission_percent)
        token = self._node.contract("XRT", xrt)
        await self._ensure(token.minter(), factory, token.setMinter(factory))
        await self._name(self._node.contract("ENSRegistry", ens), resolver, xrt=xrt, factory=factory)
        create = self._node.contract("Factory", factory).createLighthouse
        receipt = await self._call(create(plan.minimal_stake, plan.timeout_blocks, plan.lighthouse))
        return Deployment(
            ens=ens,
            resolver=resolver,
            xrt=xrt,
            factory=factory,
            lighthouse=first_event(receipt.logs, NewLighthouse).lighthouse,
            lighthouse_name=f"{plan.lighthouse}.lighthouse.{GENERATIONS[0]}.robonomics.eth",
            block_number=receipt.block_number,
            gas_used=self._gas_used,
        )

    async def _create(self, name: str, *arguments: Any) -> str:
        if name in self._found:
            return self._found[name]
        receipt = await self._sender.send(to=None, data=self._node.creation_code(name, *arguments))
        assert receipt.contract is not None
        self._gas_used += receipt.gas_used
        return receipt.contract

    async def _ensure(self, current: ContractCall, wanted: str, change: ContractCall) -> None:
        """Send `change`, unless an interrupted deployment did, so that `current` returns the address `wanted`."""
        if not self._found or await self._node.read(current) != wanted:
            await self._call(change)

    async def _call(self, call: ContractCall) -> Receipt:
        receipt = await self._sender.call(call)
        self._gas_used += receipt.gas_used
        return receipt

    async def _name(self, registry: ContractFunctions, resolver: str, *, xrt: str, factory: str) -> None:
        """Name the contracts under the roots of both generations; the factory names the lighthouses."""
        addresses = self._node.contract("Resolver", resolver)

        async def own(parent: str, label: str, owner: str) -> None:
            name = namehash(f"{label}.{parent}".rstrip("."))
            is_resolved = bool(self._found) and await self._node.read(registry.resolver(name)) == resolver
            change = registry.setSubnodeRecord(namehash(parent), keccak256(label.encode()), owner, resolver, 0)
            await (self._ensure(registry.owner(name), owner, change) if is_resolved else self._call(change))

        await own("", "eth", self._owner)
        await own("eth", "robonomics", self._owner)
        for generation in GENERATIONS:
            root = f"{generation}.robonomics.eth"
            await own("robonomics.eth", str(generation), self._owner)
            await own(root, "lighthouse", factory)
            await own(root, "model", self._owner)
            for label, address in (("xrt", xrt), ("factory", factory)):
                await own(root, label, self._owner)
                name = namehash(f"{label}.{root}")
                await self._ensure(addresses.addr(name), address, addresses.setAddr(name, address))

"""The original contracts on a test's chain.

They are not part of this repository. `AIRA_ORIGINAL_CONTRACTS` names a folder with `3/NAME.json` and `5/NAME.json`
(`abi`, `bytecode`) of all contracts of their releases 0.12 (solc 0.4.25, openzeppelin-solidity 2.0.0) and 1.0 (solc
0.5.7 for petersburg, openzeppelin-solidity 2.1.3), both with 200 runs of the optimizer.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest
from web3 import Web3

from mesh.chain import XRT, Deployment, namehash
from mesh.chain.following import NewLighthouse, first_event
from mesh.chain.transactions import TransactionSender
from schemas import keccak256

if TYPE_CHECKING:
    from mesh.chain import Account, Node

ORIGINALS: Final = os.environ.get("AIRA_ORIGINAL_CONTRACTS", "")
NEEDS_ORIGINALS: Final = pytest.mark.skipif(not ORIGINALS, reason="AIRA_ORIGINAL_CONTRACTS names no folder")
LABEL: Final = "airalab"
SUPPLY: Final = 1_000 * XRT
"""What the owner has in the beginning: in generation 3 the contract says so itself."""


class Originals:
    """The original contracts of one generation, which the `owner` deploys and holds all tokens of."""

    deployment: Deployment
    """Set by `deploy`."""

    def __init__(self, node: Node, owner: Account, generation: int) -> None:
        self.node = node
        self.owner = owner
        self.generation = generation
        self.root: Final = f"{generation}.robonomics.eth"

    async def deploy(self, *, timeout_blocks: int = 5) -> None:
        """Deploy them, and a lighthouse."""
        sender = TransactionSender(self.node, self.owner)
        ens = str((await sender.send(to=None, data=self.node.creation_code("ENSRegistry"))).contract)
        resolver = str((await sender.send(to=None, data=self.node.creation_code("Resolver", ens))).contract)
        xrt, factory = await (self._third(ens) if self.generation == 3 else self._fifth(ens))
        await self.send(self.owner, self.contract("XRT", xrt).functions.addMinter(factory))
        names, addresses = self.node.contract("ENSRegistry", ens), self.node.contract("Resolver", resolver)
        own = self.owner.address
        for parent, label, owner, address in (
            ("", "eth", own, ""),
            ("eth", "robonomics", own, ""),
            ("robonomics.eth", str(self.generation), own, ""),
            (self.root, "lighthouse", factory, ""),
            (self.root, "xrt", own, xrt),
            (self.root, "factory", own, factory),
        ):
            label_hash = keccak256(label.encode())
            await sender.call(names.setSubnodeRecord(namehash(parent), label_hash, owner, resolver, 0))
            if address:
                await sender.call(addresses.setAddr(namehash(f"{label}.{self.root}"), address))
        self.deployment = Deployment(
            ens=ens,
            resolver=resolver,
            xrt=xrt,
            factory=factory,
            lighthouse=await self.open(factory, self.owner, LABEL, timeout_blocks),
            lighthouse_name=f"{LABEL}.lighthouse.{self.root}",
            block_number=await self.node.block_number(),
            gas_used=0,
        )

    async def open(self, factory: str, by: Account, label: str, timeout_blocks: int = 5) -> str:
        """The address of a new lighthouse."""
        name = "LiabilityFactory" if self.generation == 3 else "Factory"
        create = self.contract(name, factory).functions.createLighthouse(XRT, timeout_blocks, label)
        return first_event((await self.send(by, create)).logs, NewLighthouse).lighthouse

    def contract(self, name: str, address: Any = None) -> Any:
        """A contract by the name of its artifact; without an address, to be created."""
        artifact = json.loads(Path(ORIGINALS, str(self.generation), f"{name}.json").read_text())
        return Web3().eth.contract(address, abi=artifact["abi"], bytecode=artifact["bytecode"])

    async def send(self, sender: Account, call: Any) -> Any:
        """Send a call of a contract's function, or deploy what a constructor makes."""
        data = call.data_in_transaction if hasattr(call, "data_in_transaction") else call._encode_transaction_data()
        to = getattr(call, "address", None)
        return await TransactionSender(self.node, sender).send(to=to, data=bytes.fromhex(data[2:]))

    async def create(self, name: str, *arguments: Any) -> str:
        """The address of a new contract."""
        address: str = (await self.send(self.owner, self.contract(name).constructor(*arguments))).contract
        return address

    async def _third(self, ens: str) -> tuple[str, str]:
        xrt = await self.create("XRT")
        shared = [await self.create(name) for name in ("RobotLiabilityLib", "LighthouseLib")]
        auction = await self.create("DutchAuction", self.owner.address, XRT, 1)
        return xrt, await self.create("LiabilityFactory", *shared, auction, xrt, ens)

    async def _fifth(self, ens: str) -> tuple[str, str]:
        xrt = await self.create("XRT", SUPPLY)
        shared = [await self.create(name) for name in ("Liability", "Lighthouse")]
        auction = await self.create("DutchAuction", self.owner.address, XRT, 1, 1)
        return xrt, await self.create("Factory", *shared, auction, ens, xrt)

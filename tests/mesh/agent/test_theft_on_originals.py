"""An Offer read as a Demand, on the original contracts of generation 3 with our robot: the theft, and that it fails.

The originals are not part of this repository. `AIRA_ORIGINAL_CONTRACTS` names a folder with `NAME.json` (`abi`,
`bytecode`) of XRT, RobotLiabilityLib, LighthouseLib, DutchAuction, LiabilityFactory and Lighthouse, compiled from their
release 0.12 by solc 0.4.25 with 200 runs of the optimizer and openzeppelin-solidity 2.0.0.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest
from msgspec.structs import force_setattr
from web3 import Web3

from mesh.agent import Agent
from mesh.chain import XRT, Account, Chain, UnsafeValidator
from mesh.chain.events import lighthouse_created
from mesh.chain.names import namehash
from mesh.chain.node import Node
from mesh.chain.transactions import TransactionSender
from mesh.chain.validators import Validators
from mesh.settings import Settings
from schemas import Demand, Offer, Result, Verified, keccak256, message_hash, order_abi, parse_cid
from tests.support.market import QUICK
from tests.support.objectives import objective
from tests.support.orders import MODEL, RECORDING

if TYPE_CHECKING:
    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

ORIGINALS: Final = os.environ.get("AIRA_ORIGINAL_CONTRACTS", "")
COST: Final = 5 * XRT
ROOT: Final = "3.robonomics.eth"
NOBODY: Final = "0x" + "11" * 20
BLOCKS: Final = 10_000

pytestmark = pytest.mark.skipif(not ORIGINALS, reason="AIRA_ORIGINAL_CONTRACTS names no folder")


class OriginalMarket:
    """The original contracts on a chain: a lighthouse, and one that a stranger made for the purpose."""

    def __init__(self, node: Node, keys: tuple[bytes, ...]) -> None:
        self.node = node
        self.owner, self.robot, self.stranger = (Account.from_key(key) for key in keys[:3])

    def contract(self, name: str, address: Any = None) -> Any:
        artifact = json.loads(Path(ORIGINALS, f"{name}.json").read_text())
        return Web3().eth.contract(address, abi=artifact["abi"], bytecode=artifact["bytecode"])

    async def send(self, sender: Account, call: Any) -> Any:
        """Send a call of a contract's function, or deploy what a constructor makes."""
        data = call.data_in_transaction if hasattr(call, "data_in_transaction") else call._encode_transaction_data()
        to = getattr(call, "address", None)
        return await TransactionSender(self.node, sender).send(to=to, data=bytes.fromhex(data[2:]))

    async def create(self, name: str, *arguments: Any) -> str:
        address: str = (await self.send(self.owner, self.contract(name).constructor(*arguments))).contract
        return address

    async def deploy(self) -> None:
        """Everything, and a stake of the stranger at both lighthouses."""
        sender = TransactionSender(self.node, self.owner)
        self.ens = str((await sender.send(to=None, data=self.node.creation_code("ENSRegistry"))).contract)
        resolver = str((await sender.send(to=None, data=self.node.creation_code("Resolver", self.ens))).contract)
        self.xrt = await self.create("XRT")
        shared = [await self.create(name) for name in ("RobotLiabilityLib", "LighthouseLib")]
        auction = await self.create("DutchAuction", self.owner.address, XRT, 1)
        self.factory = await self.create("LiabilityFactory", *shared, auction, self.xrt, self.ens)
        await self.send(self.owner, self.contract("XRT", self.xrt).functions.addMinter(self.factory))
        names = self.node.contract("ENSRegistry", self.ens)
        addresses = self.node.contract("Resolver", resolver)
        own = self.owner.address
        for parent, label, owner, address in (
            ("", "eth", own, ""),
            ("eth", "robonomics", own, ""),
            ("robonomics.eth", "3", own, ""),
            (ROOT, "lighthouse", self.factory, ""),
            (ROOT, "xrt", own, self.xrt),
            (ROOT, "factory", own, self.factory),
        ):
            label_hash = keccak256(label.encode())
            await sender.call(names.setSubnodeRecord(namehash(parent), label_hash, owner, resolver, 0))
            if address:
                await sender.call(addresses.setAddr(namehash(f"{label}.{ROOT}"), address))
        self.lighthouse = await self.open(self.owner, "airalab")
        self.trap = await self.open(self.stranger, "trap")
        xrt = self.contract("XRT", self.xrt).functions
        await self.send(self.owner, xrt.transfer(self.stranger.address, 100 * XRT))
        await self.send(self.owner, xrt.transfer(self.robot.address, 100 * XRT))
        await self.send(self.robot, xrt.approve(self.factory, 50 * XRT))
        for lighthouse in (self.lighthouse, self.trap):
            await self.send(self.stranger, xrt.approve(lighthouse, 10 * XRT))
            await self.send(self.stranger, self.contract("LighthouseLib", lighthouse).functions.refill(10 * XRT))

    async def open(self, by: Account, name: str) -> str:
        create = self.contract("LiabilityFactory", self.factory).functions.createLighthouse(XRT, 5, name)
        return lighthouse_created((await self.send(by, create)).logs).lighthouse

    async def balance(self, account: Account) -> int:
        return int(await self.node.read(self.node.contract("XRT", self.xrt).balanceOf(account.address)))

    async def demand(self, objective: str) -> Demand:
        """The stranger's demand, whose validator is the lighthouse that it made."""
        deadline = await self.node.block_number() + BLOCKS
        terms: dict[str, Any] = {"model": MODEL, "objective": objective, "token": self.xrt, "cost": COST}
        terms |= {"lighthouse": self.lighthouse, "validator": self.trap, "deadline": deadline}
        return self.stranger.signer.sign(Demand(**terms, nonce="ab" * 32, validator_fee=0))

    async def steal(self, offer: Offer) -> None:
        """Pair the robot's offer, as the robot's demand, with an own offer; finalize through the first lighthouse."""
        mine = Offer(
            **{name: getattr(offer, name) for name in ("model", "objective", "token", "cost", "deadline")},
            lighthouse=self.trap,
            validator=NOBODY,
            nonce="cd" * 32,
            lighthouse_fee=0,
        )
        force_setattr(mine, "validator", self.lighthouse)
        force_setattr(mine, "signature", self.stranger.signer.sign_hash(message_hash(mine)).hex())
        create = self.contract("LiabilityFactory", self.trap).functions.createLiability(
            order_abi(offer), order_abi(mine)
        )
        logs = (await self.send(self.stranger, create)).logs
        made = keccak256(b"NewLiability(address)")
        liability = next("0x" + log.topics[1].hex()[-40:] for log in logs if bytes(log.topics[0]) == made)
        liability = Web3.to_checksum_address(liability)
        result = self.stranger.signer.sign(Result(liability=liability, result=RECORDING, success=True))
        finalize = self.contract("RobotLiabilityLib", liability).encode_abi(
            "finalize", [parse_cid(RECORDING), True, bytes.fromhex(result.signature), True]
        )
        await self.send(
            self.stranger, self.contract("LighthouseLib", self.lighthouse).functions.to(liability, finalize)
        )


async def believe(self: Validators, validator: str) -> bool:
    """What a robot without the check does."""
    return True


@pytest.mark.parametrize("is_checked", [False, True], ids=["without the check", "with the check"])
async def test_a_stranger_takes_the_robots_tokens_only_without_the_check(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_checked: bool
) -> None:
    if not is_checked:
        monkeypatch.setattr(Validators, "is_safe", believe)
    async with Node(anvil.url, timing=QUICK) as node:
        market = OriginalMarket(node, anvil.private_keys)
        await market.deploy()
        before = {role: await market.balance(role) for role in (market.robot, market.stranger)}
        settings = Settings(
            connect=(router.endpoint,),
            data_dir=str(tmp_path),
            lighthouse_contract=f"airalab.lighthouse.{ROOT}",
            ens_contract=market.ens,
            contracts="original",
            playback="at-once",
        )
        chain = Chain(node, account=market.robot, ens=market.ens, generation=3, contracts="original", timing=QUICK)
        async with chain, Agent(MODEL, settings=settings, account=market.robot, chain=chain) as robot:
            work = tmp_path / "work.mcap"
            work.write_bytes(objective(("/say", "hello")))
            demand = await market.demand(await robot.add(work))
            offered = Verified(demand, message_hash(demand), market.stranger.address)
            if is_checked:
                with pytest.raises(UnsafeValidator):
                    await robot.offer(offered)
                assert robot.orders() == []
            else:
                await robot.offer(offered)
                (order,) = robot.orders()
                assert isinstance(order.message, Offer)
                await market.steal(order.message)
        stolen = 0 if is_checked else COST
        assert await market.balance(market.robot) == before[market.robot] - stolen
        assert await market.balance(market.stranger) >= before[market.stranger] + stolen

"""An Offer read as a Demand, on the original contracts of generation 3 with our robot: the theft, and that it fails."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import pytest
from msgspec.structs import force_setattr
from web3 import Web3

from mesh.agent.agent import Agent
from mesh.chain import XRT, Account, Chain, ContractNames, UnsafeValidator
from mesh.chain._node import Node
from mesh.chain._validators import Validators
from mesh.settings import Settings
from mesh.testing._market import TIMING
from schemas import Demand, Offer, Result, Verified, keccak256, message_hash, order_abi, parse_cid
from tests.support.objectives import objective
from tests.support.orders import MODEL, RECORDING
from tests.support.originals import NEEDS_ORIGINALS, Originals

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.nodes import Anvil
    from tests.support.routers import EmbeddedRouter

COST: Final = 5 * XRT
NOBODY: Final = "0x" + "11" * 20
BLOCKS: Final = 10_000

pytestmark = NEEDS_ORIGINALS


class Theft:
    """The original contracts on a chain: a lighthouse, and one that a stranger made for the purpose."""

    def __init__(self, node: Node, keys: tuple[bytes, ...]) -> None:
        self.node = node
        self.owner, self.robot, self.stranger = (Account(key) for key in keys[:3])
        self.originals = Originals(node, self.owner, 3)

    async def prepare(self) -> None:
        """Everything, and a stake of the stranger at both lighthouses."""
        send, contract = self.originals.send, self.originals.contract
        await self.originals.deploy()
        made = self.originals.deployment
        self.ens, self.xrt, self.factory, self.lighthouse = made.ens, made.xrt, made.factory, made.lighthouse
        self.trap = await self.originals.open(self.factory, self.stranger, "trap")
        xrt = contract("XRT", self.xrt).functions
        await send(self.owner, xrt.transfer(self.stranger.address, 100 * XRT))
        await send(self.owner, xrt.transfer(self.robot.address, 100 * XRT))
        await send(self.robot, xrt.approve(self.factory, 50 * XRT))
        for lighthouse in (self.lighthouse, self.trap):
            await send(self.stranger, xrt.approve(lighthouse, 10 * XRT))
            await send(self.stranger, contract("LighthouseLib", lighthouse).functions.refill(10 * XRT))

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
        create = self.originals.contract("LiabilityFactory", self.trap).functions.createLiability(
            order_abi(offer), order_abi(mine)
        )
        logs = (await self.originals.send(self.stranger, create)).logs
        made = keccak256(b"NewLiability(address)")
        liability = next("0x" + log.topics[1].hex()[-40:] for log in logs if bytes(log.topics[0]) == made)
        liability = Web3.to_checksum_address(liability)
        result = self.stranger.signer.sign(Result(liability=liability, result=RECORDING, success=True))
        finalize = self.originals.contract("RobotLiabilityLib", liability).encode_abi(
            "finalize", [parse_cid(RECORDING), True, bytes.fromhex(result.signature), True]
        )
        await self.originals.send(
            self.stranger, self.originals.contract("LighthouseLib", self.lighthouse).functions.to(liability, finalize)
        )


async def believe(self: Validators, order: Demand | Offer) -> None:
    """What a robot without the check does."""


@pytest.mark.parametrize("is_checked", [False, True], ids=["without the check", "with the check"])
async def test_a_stranger_takes_the_robots_tokens_only_without_the_check(
    anvil: Anvil, router: EmbeddedRouter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_checked: bool
) -> None:
    if not is_checked:
        monkeypatch.setattr(Validators, "check", believe)
    async with Node(anvil.url, timing=TIMING) as node:
        market = Theft(node, anvil.private_keys)
        await market.prepare()
        before = {role: await market.balance(role) for role in (market.robot, market.stranger)}
        settings = Settings(
            connect=(router.endpoint,),
            data_dir=str(tmp_path),
            lighthouse_contract=market.originals.deployment.lighthouse_name,
            ens_contract=market.ens,
            contracts="original",
            playback="at-once",
        )
        chain = Chain(
            node,
            account=market.robot,
            contracts=ContractNames(ens=market.ens, generation=3, kind="original"),
            timing=TIMING,
        )
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

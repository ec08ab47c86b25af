"""A market to develop on: contracts on a fresh chain, three people with money, a provider with its stake."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mesh.chain import XRT, Account, Chain, Deployment, DeploymentPlan, NoContracts, Node, Timing, deploy, namehash

if TYPE_CHECKING:
    from collections.abc import Sequence

    from web3.providers.async_base import AsyncBaseProvider

ROLES: Final = ("provider", "robot", "person")
"""Who has an account, in the order of the development chain's keys."""
ALLOWANCE: Final = 1_000 * XRT
"""What person and robot start with, wn."""
STAKE: Final = 100 * XRT
"""What the provider stakes, wn: a hundred transactions a turn."""
TIMING: Final = Timing(poll_interval=0.1)


@dataclass(frozen=True, kw_only=True)
class Market:
    """What was founded: the contracts' addresses, and an account for each role."""

    deployment: Deployment
    accounts: dict[str, Account]

    def chain(self, endpoint: str | AsyncBaseProvider, role: str) -> Chain:
        """The chain as `role` uses it, not yet open."""
        return Chain(endpoint, account=self.accounts[role], ens=self.deployment.ens, timing=TIMING)


async def find_market(endpoint: str, keys: Sequence[bytes]) -> Market | None:
    """The market that an earlier `found_market` made with the same keys; None if nobody ever sent anything.

    Raises `NoContracts` for a chain on which something else, or only a part of a market, was made.
    """
    accounts = {role: Account.from_key(key) for role, key in zip(ROLES, keys, strict=False)}
    async with Node(endpoint, timing=TIMING) as node:
        if not await node.web3.eth.get_transaction_count(node.checksum(accounts["provider"].address)):
            return None
        async with Chain(node, account=accounts["provider"]) as chain:
            root = namehash("3.robonomics.eth")
            resolver = await node.read(node.contract("ENSRegistry", chain.ens).functions.resolver(root))
            made = next(iter(await chain.lighthouses.list()), None)
            if (
                made is None
                or accounts["provider"].address not in (await chain.lighthouses.get(made.lighthouse)).stakes
            ):
                raise NoContracts("lighthouse with a provider", chain.chain_id)
            return Market(
                deployment=Deployment(
                    ens=chain.ens,
                    resolver=str(resolver),
                    xrt=chain.xrt,
                    factory=chain.factory,
                    lighthouse=made.lighthouse,
                    lighthouse_name=f"{made.name}.lighthouse.3.robonomics.eth",
                    block_number=await chain.block_number(),
                    gas_used=0,
                ),
                accounts=accounts,
            )


async def found_market(endpoint: str | AsyncBaseProvider, keys: Sequence[bytes]) -> Market:
    """Deploy the contracts with the first of `keys`, give each role its money, and stake for the provider."""
    accounts = {role: Account.from_key(key) for role, key in zip(ROLES, keys, strict=False)}
    deployment = await deploy(endpoint, accounts["provider"], plan=DeploymentPlan(timeout_blocks=100))
    market = Market(deployment=deployment, accounts=accounts)
    async with market.chain(endpoint, "provider") as chain:
        for role in ("robot", "person"):
            await chain.tokens.transfer(accounts[role].address, ALLOWANCE)
        await chain.tokens.approve(deployment.lighthouse, STAKE)
        await chain.lighthouses.refill(deployment.lighthouse, STAKE)
    return market

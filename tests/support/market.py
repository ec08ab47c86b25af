"""A place in a market for tests that need its parts one by one; `mesh.testing.Market` has them all at work.

It stands on the kit's chain. Its accounts, its lighthouse and that chain are shared by all tests of a run, so tests
compare balances before and after. Each test has its own router, provider, agents and folders.
"""

from __future__ import annotations

import asyncio
import dataclasses
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

from mesh.agent.agent import Agent
from mesh.chain import Account, Chain, ContractNames, Timing
from mesh.network import Endpoints, Network
from mesh.settings import Settings
from mesh.testing._market import RESEND, TIMING, place_of, working_provider
from schemas import Offer, cid_of_bytes
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.agent.contracts import Contract
    from mesh.agent.ledger import Phase
    from mesh.dev.development import DevelopmentMarket
    from mesh.market.provider import Provider
    from mesh.testing import MarketChain
    from schemas import Demand, Verified

MODEL = cid_of_bytes(b"what the robots of the tests can do")


@dataclass(frozen=True)
class ForeignChain:
    """A market on a node that the kit does not make: anvil, or the original contracts."""

    node: Any
    market: DevelopmentMarket
    contracts: Literal["mesh", "original"] = "mesh"
    generation: Literal[3, 5] = 3


class Place:
    """Where a test's agents meet. `async with Place(chain, endpoint, folder) as place`.

    `node` is the address by which they reach the chain, if not directly.
    """

    def __init__(
        self,
        chain: MarketChain | ForeignChain,
        endpoint: str,
        folder: Path,
        *,
        node: str = "",
        timing: Timing = TIMING,
    ) -> None:
        foreign = chain if isinstance(chain, ForeignChain) else ForeignChain(chain.node, chain.market)
        self.generation, self.contracts = foreign.generation, foreign.contracts
        self._url = node
        self._timing = timing
        self.node = foreign.node
        self.market = foreign.market
        self.endpoint = endpoint
        self.folder = folder
        self.chains: dict[str, Chain] = {}
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        for role in self.market.accounts:
            self.chains[role] = await self._stack.enter_async_context(self.chain(role))
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    def chain(self, role: str) -> Chain:
        """The chain for an account, not yet open."""
        return self.chain_of(self.market.accounts[role], self.generation)

    def chain_of(self, account: Account, generation: Literal[3, 5], *, timing: Timing | None = None) -> Chain:
        """The chain for any account in a generation, not yet open."""
        return Chain(
            self._url or self.node.provider,
            account=account,
            contracts=ContractNames(ens=self.market.deployment.ens, generation=generation, kind=self.contracts),
            timing=timing or self._timing,
        )

    def address(self, role: str) -> str:
        """A role's account."""
        return self.market.accounts[role].address

    async def balance(self, role: str) -> int:
        """The balance of a role, wn."""
        return await self.chains[role].tokens.balance(self.address(role))

    def settings(self, role: str, **options: Any) -> Settings:
        """Settings of an agent of that role, `options` changed. Objectives are played at once."""
        deployment = self.market.deployment
        given = place_of(self.endpoint, self.folder / role, deployment.lighthouse_name, ens=deployment.ens)
        ours = {
            "generation": self.generation,
            "contracts": self.contracts,
            "fetch_timeout": 5.0,
            "answer_timeout": 60.0,
        }
        return dataclasses.replace(Settings(), **(given | ours | options))

    def agent(self, role: str, model: str | Path = MODEL, **options: Any) -> Agent:
        """An agent of that role, not yet running; handlers can be added. Always with the same memory."""
        settings = self.settings(role, **options)
        account, chain = self.market.accounts[role], self.chains[role]
        return Agent(model, settings=settings, account=account, chain=chain, resend=RESEND)

    @asynccontextmanager
    async def another(
        self, key: int | bytes, *, timing: Timing | None = None, generation: Literal[0, 3, 5] = 0, **options: Any
    ) -> AsyncIterator[Agent]:
        """An agent with another account, by the number of its key or that key, not yet running."""
        account = Account(self.node.funded_keys[key] if isinstance(key, int) else key)
        settings = self.settings(account.address, generation=generation or self.generation, **options)
        async with self.chain_of(account, settings.generation, timing=timing) as chain:
            yield Agent(MODEL, settings=settings, account=account, chain=chain, resend=RESEND)

    @asynccontextmanager
    async def provider(self, *, seconds: float = 180, **options: Any) -> AsyncIterator[Provider]:
        """The lighthouse's provider at work, with these options, for so long at most: no test may hang."""
        async with (
            asyncio.timeout(seconds),
            Network(Endpoints(connect=(self.endpoint,))) as network,
            working_provider(
                network.session, self.chains["provider"], self.market.deployment.lighthouse_name, **options
            ) as provider,
        ):
            yield provider

    @asynccontextmanager
    async def at_work(self, *agents: Agent) -> AsyncIterator[Agent]:
        """The provider and these agents at work; gives a person's agent."""
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(self.provider())
            for agent in agents:
                await stack.enter_async_context(agent)
            yield await stack.enter_async_context(self.agent("person"))

    async def forget_blocks(self, count: int) -> None:
        """Reorganise the chain: one more empty block than there were replace its last blocks and their transactions."""
        head = await self.chains["provider"].block_number()
        await self.node.request("evm_revert", [hex(head - count)])
        await self.node.mine(count + 1)

    def save(self, content: bytes, name: str = "objective.mcap") -> Path:
        """A file of the person's."""
        path = self.folder / name
        path.write_bytes(content)
        return path


def contracts_in(options: dict[str, Any], **given: Any) -> ContractNames:
    """Those of the options of a chain that say which contracts are meant, taken out of them."""
    names = [one.name for one in dataclasses.fields(ContractNames) if one.name in options]
    return ContractNames(**(given | {name: options.pop(name) for name in names}))


def offering(robot: Agent) -> Agent:
    """The same robot, with a handler that offers for every demand."""

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        await robot.offer(demand)

    return robot


def offering_unseen(robot: Agent) -> Agent:
    """The same robot, with a handler that offers without examining the objective: bad jobs fail only later."""

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        trader = robot.runtime.trader
        await trader.post(Offer, trader.writer.terms_of(demand.message), lighthouse_fee=0)

    return robot


async def in_phase(robot: Agent, contract: Contract, phase: Phase) -> None:
    """Wait until a job has come to that phase at the robot."""

    async def reached() -> bool:
        job = await robot.parts.ledger.job(contract.address)
        return job is not None and job.phase is phase

    await until_found(reached, what=phase)

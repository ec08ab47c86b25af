"""A market for tests: founded once, on an embedded chain; each test has its own router, provider, agents and folders.

Accounts and the chain are shared by all tests of a run, so tests compare balances before and after.
"""

from __future__ import annotations

import asyncio
import dataclasses
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import pytest

from mesh.agent.agent import Agent
from mesh.base.background import Background
from mesh.base.retry import RetryPolicy
from mesh.chain import Chain, Timing
from mesh.dev import EmbeddedChain
from mesh.dev.development import DevelopmentMarket, deploy_market
from mesh.market.provider import Provider, ProviderOptions
from mesh.network import Endpoints, Network
from mesh.settings import Settings
from schemas import Offer, cid_of_bytes
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from mesh.agent.contracts import Contract
    from mesh.agent.ledger import Phase
    from mesh.chain import Account
    from schemas import Demand, Verified
    from tests.support.routers import EmbeddedRouter

MODEL = cid_of_bytes(b"what the robots of the tests can do")
QUICK_RESEND = RetryPolicy(initial=0.1, ceiling=0.5)
QUICK = Timing(poll_interval=0.03, receipt_interval=0.01, metrics_age=0.0)


@dataclass(frozen=True)
class Founded:
    """A chain in a thread of its own, which any event loop may use, and the market on it."""

    node: EmbeddedChain
    market: DevelopmentMarket
    contracts: Literal["mesh", "original"] = "mesh"
    generation: Literal[3, 5] = 3


@pytest.fixture(scope="session")
def founded() -> Iterator[Founded]:
    """A market on an embedded chain, for the whole run."""
    with asyncio.Runner() as runner:
        stack = AsyncExitStack()
        node = runner.run(stack.enter_async_context(EmbeddedChain()))
        try:
            yield Founded(node, runner.run(deploy_market(node.provider, node.funded_keys)))
        finally:
            runner.run(stack.aclose())


class Place:
    """Where a test's agents meet. `async with Place(founded, endpoint, folder) as place`.

    `node` is the address by which they reach the chain, if not directly.
    """

    def __init__(
        self, founded: Founded, endpoint: str, folder: Path, *, node: str = "", timing: Timing = QUICK
    ) -> None:
        self.founded = founded
        self._url = node
        self._timing = timing
        self.node = founded.node
        self.market = founded.market
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
        return self.chain_of(self.market.accounts[role], self.founded.generation)

    def chain_of(self, account: Account, generation: Literal[3, 5]) -> Chain:
        """The chain for any account in a generation, not yet open."""
        return Chain(
            self._url or self.node.provider,
            account=account,
            ens=self.market.deployment.ens,
            generation=generation,
            contracts=self.founded.contracts,
            timing=self._timing,
        )

    def address(self, role: str) -> str:
        """A role's account."""
        return self.market.accounts[role].address

    async def balance(self, role: str) -> int:
        """The balance of a role, wn."""
        return await self.chains[role].tokens.balance(self.address(role))

    def settings(self, role: str, **options: Any) -> Settings:
        """Settings of an agent of that role, `options` changed. Objectives are played at once."""
        settings = Settings(
            connect=(self.endpoint,),
            data_dir=str(self.folder / role),
            lighthouse_contract=self.market.deployment.lighthouse_name,
            ens_contract=self.market.deployment.ens,
            generation=self.founded.generation,
            contracts=self.founded.contracts,
            poll_interval=QUICK.poll_interval,
            playback="at-once",
            fetch_timeout=5.0,
            answer_timeout=60.0,
        )
        return dataclasses.replace(settings, **options)

    def agent(self, role: str, model: str | Path = MODEL, **options: Any) -> Agent:
        """An agent of that role, not yet running; handlers can be added. Always with the same memory."""
        settings = self.settings(role, **options)
        account, chain = self.market.accounts[role], self.chains[role]
        return Agent(model, settings=settings, account=account, chain=chain, resend=QUICK_RESEND)

    @asynccontextmanager
    async def provider(self, *, seconds: float = 180, **options: Any) -> AsyncIterator[Provider]:
        """The lighthouse's provider at work, with these options, for so long at most: no test may hang."""
        async with (
            asyncio.timeout(seconds),
            Network(Endpoints(connect=(self.endpoint,))) as network,
            Provider(
                network.session,
                self.chains["provider"],
                self.market.deployment.lighthouse_name,
                ProviderOptions(**options),
            ) as provider,
            Background() as tasks,
        ):
            tasks.start(provider.run(), "provider of the test")
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


@pytest.fixture
async def place(founded: Founded, router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    """A market's place of this test's own."""
    async with Place(founded, router.endpoint, tmp_path) as open_place:
        yield open_place

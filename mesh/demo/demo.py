"""One job, told as it happens: every role on a session of its own through a local router, on an embedded chain."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mesh.agent import Agent, Phase
from mesh.background import Background
from mesh.chain import XRT
from mesh.demo.device import BLINK, Lamp
from mesh.demo.objective import write_objective
from mesh.devchain import EmbeddedChain
from mesh.devchain.market import ROLES, Market, found_market
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.market.provider import Provider
from mesh.network import Endpoints, Network, free_endpoint
from mesh.recording import open_objective
from mesh.settings import Settings
from schemas import Demand, Verified, cid_of_bytes, cid_of_file

if TYPE_CHECKING:
    from web3.providers.async_base import AsyncBaseProvider

    from mesh.agent import Contract, Outcome
    from mesh.demo.story import JsonStory, SpokenStory
    from mesh.market.book import Match
    from mesh.recording import Objective
    from schemas import Liability

COST: Final = 42 * XRT
"""What the person pays, wn."""
MODEL: Final = cid_of_bytes(b"aira-mesh demo: a lamp that blinks for each message\n")
"""The behaviour model of the demo's robot: any content has a name."""
PATIENCE: Final = 60.0
"""Seconds until a demand that nobody takes is given up; for the job, beyond the time that its objective takes."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """What to show: the objective's file (None: three blinks), the generation of the messages, where files are kept."""

    objective: Path | None
    generation: int
    out: Path | None
    story: SpokenStory | JsonStory

    async def run(self) -> None:
        """Run the whole story. Raises an `AiraError` before anything is created when the objective is unfit."""
        started = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="aira-demo-") as temporary:
            scene = Path(temporary)
            objective = await asyncio.to_thread(self._prepare, scene)
            try:
                async with AsyncExitStack() as stack:
                    stage = await _Stage.set_up(self, stack, scene)
                    await stage.play(objective, started)
            except TimeoutError:
                raise RemoteError("the demo stands still", hint="is this machine very busy? try again") from None

    def _prepare(self, scene: Path) -> Objective:
        """The objective, examined, and a place for what is kept. Raises `InputError`, `ConfigurationError`."""
        if self.out is not None:
            try:
                self.out.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigurationError(f"can't keep files in {self.out}: {error.strerror}") from None
        path = self.objective
        if path is None:
            path = scene / "blink.mcap"
            write_objective(path)
        elif not path.is_file():
            raise InputError(f"there is no file {path}", hint="give an MCAP file or a ROS 1 bag")
        return open_objective(path)


class _Stage:
    """Router, chain, provider, robot and person, all open."""

    def __init__(self, demo: Demo, scene: Path) -> None:
        self._story = demo.story
        self._demo = demo
        self._scene = scene
        self._endpoint = free_endpoint()
        self._match: Match | None = None
        self._success = False
        self._finalized = asyncio.Event()

    @classmethod
    async def set_up(cls, demo: Demo, stack: AsyncExitStack, scene: Path) -> _Stage:
        """Open everything in its order; `stack` closes it."""
        stage = cls(demo, scene)
        demo.story.chapter("A market is founded")
        await stage._open_network(stack)
        node = await stack.enter_async_context(EmbeddedChain())
        stage._market = await found_market(node.provider, node.funded_keys)
        stage._tell_contracts()
        await stage._open_provider(stack, node.provider)
        stage._robot = await stage._open_agent(stack, node.provider, "robot")
        stage._person = await stage._open_agent(stack, node.provider, "person")
        return stage

    _market: Market
    _robot: Agent
    _person: Agent

    async def play(self, objective: Objective, started: float) -> None:
        """The job, from the demand to the payment."""
        story, person, path = self._story, self._person, objective.path
        before = await self._balances()
        story.chapter("A person wants work done")
        cid = await asyncio.to_thread(cid_of_file, path)
        story.tell("person", "objective", f"holds the objective {path.name}\n{cid}", objective=cid, file=str(path))
        story.tell("person", "asking", f"will pay {_xrt(COST)} for it, and publishes a Demand", model=MODEL, cost=COST)
        async with asyncio.timeout(PATIENCE):
            contract = await person.demand(path, cost=COST)
        async with asyncio.timeout(PATIENCE + objective.duration_ns / 1e9 + objective.count * BLINK):
            outcome = await contract.outcome()
            await self._finalized.wait()
        recording = await contract.recording()
        self._tell_payment(before, await self._balances())
        kept = await asyncio.to_thread(self._keep, recording, outcome.result, path, cid)
        story.tell(
            "person", "recording", f"has the recording {kept}\n{outcome.result}", result=outcome.result, path=kept
        )
        self._end(contract, outcome, cid, started)

    def _end(self, contract: Contract, outcome: Outcome, objective: str, started: float) -> None:
        assert self._match is not None
        self._story.end(
            liability=contract.address,
            demand=self._match.demand.hash.hex(),
            offer=self._match.offer.hash.hex(),
            objective=objective,
            result=outcome.result,
            success=self._success,
            paid=outcome.success,
            cost=COST,
            generation=self._demo.generation,
            seconds=round(time.monotonic() - started, 3),
        )

    async def _open_network(self, stack: AsyncExitStack) -> None:
        network = await stack.enter_async_context(Network(Endpoints(listen=(self._endpoint,), mode="router")))
        self._story.tell(
            "market",
            "router",
            f"Zenoh router at {self._endpoint}, id {network.id}",
            endpoint=self._endpoint,
            zid=network.id,
        )

    def _tell_contracts(self) -> None:
        deployment = self._market.deployment
        self._story.tell(
            "market",
            "contracts",
            f"contracts on an embedded chain\nfactory    {deployment.factory}\nlighthouse {deployment.lighthouse}"
            f"  {deployment.lighthouse_name}\nXRT        {deployment.xrt}",
            factory=deployment.factory,
            lighthouse=deployment.lighthouse,
            name=deployment.lighthouse_name,
            xrt=deployment.xrt,
        )

    async def _open_provider(self, stack: AsyncExitStack, node: AsyncBaseProvider) -> None:
        network = await stack.enter_async_context(Network(Endpoints(connect=(self._endpoint,))))
        chain = await stack.enter_async_context(self._market.chain(node, "provider"))
        lighthouse = self._market.deployment.lighthouse_name
        provider = await stack.enter_async_context(
            Provider(network.session, chain, lighthouse, matched=self._tell_match)
        )
        tasks = await stack.enter_async_context(Background())
        tasks.start(provider.run(), "demo provider")
        self._introduce("provider", provider.address, network.id)

    async def _open_agent(self, stack: AsyncExitStack, node: AsyncBaseProvider, role: str) -> Agent:
        settings = Settings(
            connect=(self._endpoint,),
            data_dir=str(self._scene / role),
            lighthouse_contract=self._market.deployment.lighthouse_name,
            ens_contract=self._market.deployment.ens,
            generation=5 if self._demo.generation == 5 else 3,
        )
        chain = await stack.enter_async_context(self._market.chain(node, role))
        agent = Agent(MODEL, settings=settings, account=self._market.accounts[role], chain=chain)
        if role == "robot":
            self._teach(agent)
        await stack.enter_async_context(agent)
        self._introduce(role, agent.address, agent.parts.network.id)
        return agent

    def _introduce(self, role: str, address: str, zid: str) -> None:
        self._story.tell(role, "account", f"account {address}, Zenoh id {zid}", address=address, zid=zid)

    def _teach(self, robot: Agent) -> None:
        """What the robot does: it offers to do every demand of its model, and plays objectives to its lamp."""
        lamp = Lamp(self._story)
        robot.on("*")(lamp.play)

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            self._story.tell(
                "robot",
                "demand",
                f"hears the Demand {demand.hash.hex()[:16]}… and publishes an Offer",
                demand=demand.hash.hex(),
                promisee=demand.signer,
            )
            await robot.offer(demand)

        @robot.on_liability
        async def phase(phase: Phase, liability: Liability) -> None:
            self._tell_phase(phase, liability)

    def _tell_match(self, match: Match) -> None:
        self._match = match
        self._story.tell(
            "provider",
            "match",
            "Demand and Offer agree; asks the lighthouse for a contract",
            demand=match.demand.hash.hex(),
            offer=match.offer.hash.hex(),
        )

    def _tell_phase(self, phase: Phase, liability: Liability) -> None:
        """The job's way, as the robot's own ledger tells it."""
        tell, address = self._story.tell, liability.address
        match phase:
            case Phase.INCOMING:
                self._story.chapter("A contract holds the money")
                tell(
                    "contract",
                    "liability",
                    f"liability {address} holds {_xrt(liability.cost)}",
                    liability=address,
                    cost=int(liability.cost),
                )
                tell("robot", "incoming", "fetches the objective by its CID and examines it", liability=address)
            case Phase.READY:
                tell("robot", "ready", "is ready", liability=address)
            case Phase.RUNNING:
                self._story.chapter("The robot works")
                tell("robot", "running", "plays the objective and records its device", liability=address)
            case Phase.COMPLETE:
                self._success = liability.is_success
                done = "done" if liability.is_success else "not done"
                tell(
                    "robot",
                    "complete",
                    f"signs the Result: {done}, recording\n{liability.result}",
                    liability=address,
                    result=liability.result,
                    success=liability.is_success,
                )
                self._story.chapter("The contract pays" if liability.is_success else "The contract refunds")
            case Phase.FINALIZED:
                tell("contract", "finalized", "liability is finalized", liability=address)
                self._finalized.set()

    def _tell_payment(self, before: dict[str, int], after: dict[str, int]) -> None:
        for role in ROLES:
            words = f"had {_xrt(before[role])}, has {_xrt(after[role])}"
            self._story.tell(role, "balance", words, before=before[role], after=after[role])

    async def _balances(self) -> dict[str, int]:
        chain = self._person.parts.chain
        return {role: await chain.tokens.balance(account.address) for role, account in self._market.accounts.items()}

    def _keep(self, recording: Path, result: str, objective: Path, cid: str) -> str:
        """Copy recording and objective, by their CIDs, to where they outlive the demo; says where the recording is."""
        out = self._demo.out
        if out is None:
            return f"{result}.mcap (keep it with --out DIR)"
        kept = out / f"{result}.mcap"
        for source, target in ((objective, out / f"{cid}{objective.suffix}"), (recording, kept)):
            try:
                shutil.copyfile(source, target)
            except shutil.SameFileError:
                continue  # what an earlier demo kept is played again
            except OSError as error:
                raise ConfigurationError(f"can't keep {target}: {error.strerror}") from None
        return str(kept)


def _xrt(wn: int) -> str:
    """An amount of wn in XRT, as people write it."""
    return f"{wn / XRT:,.9f}".rstrip("0").rstrip(".") + " XRT"

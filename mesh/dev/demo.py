"""`aira demo`: one job from demand to payment, on a whole market in one process. Each role has a Zenoh session of
its own; the chain is embedded, the device a simulated lamp.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import time
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
from mcap.writer import Writer
from rich.console import Console
from rich.text import Text

from mesh.agent.agent import Agent
from mesh.agent.ledger import Phase
from mesh.amounts import XRT as UNIT
from mesh.base.background import Background
from mesh.chain import XRT
from mesh.dev import EmbeddedChain
from mesh.dev.development import ROLES, DevelopmentMarket, deploy_market
from mesh.errors import ConfigurationError, InputError, RemoteError
from mesh.market.provider import Provider, ProviderOptions
from mesh.network import Endpoints, Network, free_endpoint
from mesh.recording import open_objective
from mesh.settings import Settings
from schemas import EMPTY, Demand, Empty, String, Verified, cid_of_file
from schemas.model import ModelDescription, ModelTopic, ValueSchema

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.contracts import Contract, Outcome
    from mesh.agent.handlers import Job
    from mesh.chain.rpc import Transport
    from mesh.dev.page import ServePage
    from mesh.market.book import Match
    from mesh.recording import Objective
    from schemas import Liability


BLINK_SECONDS: Final = 0.1
"""How long the lamp is on for one message."""
TOPIC: Final = "/blink"


class Lamp:
    """An LED that blinks for any message, in the colour that a String names."""

    def __init__(self, narrator: Narrator) -> None:
        self._narrator = narrator

    async def play(self, job: Job, message: Any) -> None:
        """Blink once, and publish `on` and `off` on the job's topic `/led`."""
        colour = message.data if isinstance(message, String) else ""
        self._narrator.event("robot", "played", f"plays {_shown(message)}", message=_shown(message))
        await self._switch(job, "on", colour)
        await asyncio.sleep(BLINK_SECONDS)
        await self._switch(job, "off", colour)

    async def _switch(self, job: Job, state: str, colour: str) -> None:
        name = f"{colour} LED" if colour in ("red", "blue") else "LED"
        symbol = "●" if state == "on" else "○"
        self._narrator.event("device", "led", f"{symbol} {name} {state}", state=state, colour=colour)
        job.publish("/led", String(f"{colour} {state}".strip()))


def write_objective(path: Path) -> None:
    """Write an MCAP recording with three std_msgs/Empty on `/blink`, 0.4 s apart. The same bytes each time."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="aira-mesh")
        schema = writer.register_schema(EMPTY.schema_name, EMPTY.schema_encoding, EMPTY.schema_data)
        channel = writer.register_channel(TOPIC, EMPTY.encoding, schema)
        for number in range(3):
            at = number * 400_000_000
            writer.add_message(channel, log_time=at, publish_time=at, data=b"", sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]


def _shown(message: Any) -> str:
    """A message as text for a terminal, without control characters: an objective may come from anyone."""
    if isinstance(message, Empty):
        return "std_msgs/Empty"
    text = f"{len(message)} bytes" if isinstance(message, bytes) else str(getattr(message, "data", message))
    shown = "".join(letter if letter.isprintable() else "\ufffd" for letter in text[:60])
    return shown if len(text) == len(shown) else f"{shown}…"


COLOURS: Final = {
    "market": "cyan",
    "person": "magenta",
    "robot": "green",
    "provider": "yellow",
    "contract": "blue",
    "device": "bright_red",
}


class Narrator(Protocol):
    """Reports the demo, event by event."""

    def chapter(self, title: str) -> None:
        """Begin a chapter."""

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Report what `who` does: `event` and `facts` for programs, `text` for people."""

    def summary(self, **facts: Any) -> None:
        """Report the end."""


class TextNarrator:
    """Reports in plain text, coloured on a terminal. Lines are not wrapped, so that addresses stay whole."""

    def __init__(self) -> None:
        self._console = Console(file=sys.stdout, soft_wrap=True, highlight=False)

    def chapter(self, title: str) -> None:
        """Print the title after an empty line."""
        self._print(Text(), Text(title, style="bold"))

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Print the text, further lines indented."""
        first, *rest = text.splitlines()
        line = Text.assemble((f"  {who:<9}", COLOURS.get(who, "")), " ", first)
        self._print(line, *(Text(" " * 12 + more, style="dim") for more in rest))

    def summary(self, **facts: Any) -> None:
        """Print how long it took, and whether the robot was paid."""
        paid = "paid" if facts["paid"] else "refunded"
        self._print(Text(), Text(f"Done in {facts['seconds']:.1f} s: the job was {paid}.", style="bold"))

    def _print(self, *lines: Text) -> None:
        with self._console.capture() as rendered:
            for line in lines:
                self._console.print(line)
        _write(rendered.get())


class JsonNarrator:
    """Prints a JSON object for each event; the last one is the summary."""

    def chapter(self, title: str) -> None:
        """Print nothing."""

    def event(self, who: str, event: str, text: str, **facts: Any) -> None:
        """Print the event's facts."""
        self._print({"event": event, "who": who, **facts})

    def summary(self, **facts: Any) -> None:
        """Print the facts."""
        self._print(facts)

    @staticmethod
    def _print(line: dict[str, Any]) -> None:
        _write(msgspec.json.encode(line).decode() + "\n")


def _write(text: str) -> None:
    """Write to stdout. If its reader closes it (`aira demo | head`), the demo continues without output."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())


_xrt: Final = UNIT.show

COST: Final = 42 * XRT
"""What the person pays, wn."""
DESCRIPTION: Final = ModelDescription(
    title="Blink",
    description="A lamp that blinks once for each message, in the colour that a text names.",
    objective=(
        ModelTopic(
            topic="/colour",
            title="Lamp",
            encoding="ros1;std_msgs/String",
            value=ValueSchema(type="string", title="Colour", default="red", enum=("red", "blue")),
        ),
    ),
    other_topics=True,
    result=(ModelTopic(topic="/led", title="What the lamp did"),),
    success="The lamp has blinked for each message.",
    price=UNIT.show(COST),
)
"""What the demo's robot does."""
MODEL: Final = DESCRIPTION.cid


class Demo:
    """The demo: router, chain, provider, robot and person.

    `folder` is for its files; the caller removes it once the event loop and its threads have ended. `objective` is a
    file (None: three blinks), `generation` that of the messages, `out` the folder that keeps objective and recording
    (None: nowhere). `timeout` is in seconds, for the demand to become a contract, and for the job in addition to its
    objective's duration. With `page` the market's page is served, and `run` continues until it is cancelled.
    """

    def __init__(
        self,
        folder: Path,
        *,
        objective: Path | None,
        generation: int,
        out: Path | None,
        narrator: Narrator,
        timeout: float = 60.0,
        page: ServePage | None = None,
    ) -> None:
        self._folder = folder
        self._path = objective
        self._generation = generation
        self._out = out
        self._narrator = narrator
        self._timeout = timeout
        self._page = page
        self._match: Match | None = None
        self._success = False
        self._finalized = asyncio.Event()
        self._market: DevelopmentMarket
        self._person: Agent

    async def run(self) -> None:
        """Run the whole demo, once. Raises `InputError`, `ConfigurationError` at the start, and `RemoteError`."""
        started = time.monotonic()
        objective = await asyncio.to_thread(self._prepare)
        try:
            async with AsyncExitStack() as stack:
                await self._open(stack)
                url, person = "", self._person
                if self._page is not None:  # from before the job on, so that it sees each step
                    served = self._page(person.settings, chain=person.parts.chain, agent=person)
                    url = await stack.enter_async_context(served)
                contract = await self._do_job(objective, started)
                if url:
                    shown = f"{url}/#/job/{contract.address}"
                    self._narrator.chapter("The page")
                    self._narrator.event(
                        "person", "page", f"{shown}\nshows this job; Ctrl-C ends everything", url=shown
                    )
                    await asyncio.Event().wait()
        except TimeoutError:
            raise RemoteError(
                "the demo did not finish in time", hint="is this machine very busy? try again", code="demo-stalled"
            ) from None

    def _prepare(self) -> Objective:
        """Check the objective, and make the output folder."""
        if self._out is not None:
            try:
                self._out.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigurationError(
                    f"can't keep files in {self._out}: {error.strerror}", code="output-not-writable"
                ) from None
        path = self._path
        if path is None:
            path = self._folder / "blink.mcap"
            write_objective(path)
        elif not path.is_file():
            raise InputError(f"there is no file {path}", hint="give an MCAP file or a ROS 1 bag")
        return open_objective(path)

    async def _open(self, stack: AsyncExitStack) -> None:
        """Open router, chain, provider, robot and person; `stack` closes them."""
        self._narrator.chapter("A market is founded")
        self._endpoint = free_endpoint()
        network = await stack.enter_async_context(Network(Endpoints(listen=(self._endpoint,), mode="router")))
        router = f"Zenoh router at {self._endpoint}, id {network.id}"
        self._narrator.event("market", "router", router, endpoint=self._endpoint, zid=network.id)
        node = await stack.enter_async_context(EmbeddedChain())
        self._market = await deploy_market(node.provider, node.funded_keys)
        deployment = self._market.deployment
        self._narrator.event(
            "market",
            "contracts",
            f"contracts on an embedded chain\nfactory    {deployment.factory}\nlighthouse {deployment.lighthouse}"
            f"  {deployment.lighthouse_name}\nXRT        {deployment.xrt}",
            factory=deployment.factory,
            lighthouse=deployment.lighthouse,
            name=deployment.lighthouse_name,
            xrt=deployment.xrt,
        )
        await self._open_provider(stack, node.provider)
        await self._open_agent(stack, node.provider, "robot")
        self._person = await self._open_agent(stack, node.provider, "person")

    async def _open_provider(self, stack: AsyncExitStack, node: Transport) -> None:
        network = await stack.enter_async_context(Network(Endpoints(connect=(self._endpoint,))))
        chain = await stack.enter_async_context(self._market.chain(node, "provider"))
        lighthouse = self._market.deployment.lighthouse_name
        options = ProviderOptions(store=self._folder / "provider" / "provider.sqlite")
        provider = await stack.enter_async_context(
            Provider(network.session, chain, lighthouse, options, matched=self._report_match)
        )
        tasks = await stack.enter_async_context(Background())
        tasks.start(provider.run(), "demo provider")
        self._report_account("provider", provider.address, network.id)

    async def _open_agent(self, stack: AsyncExitStack, node: Transport, role: str) -> Agent:
        settings = Settings(
            connect=(self._endpoint,),
            data_dir=str(self._folder / role),
            lighthouse_contract=self._market.deployment.lighthouse_name,
            ens_contract=self._market.deployment.ens,
            generation=5 if self._generation == 5 else 3,
            name="Lamp" if role == "robot" else "",
        )
        chain = await stack.enter_async_context(self._market.chain(node, role))
        agent = Agent(MODEL, settings=settings, account=self._market.accounts[role], chain=chain)
        if role == "robot":
            self._add_handlers(agent)
        await stack.enter_async_context(agent)
        if role == "robot":
            model = self._folder / "model.json"
            await asyncio.to_thread(model.write_bytes, DESCRIPTION.encode())
            await agent.add(model)
            await agent.control(price=DESCRIPTION.price)
        self._report_account(role, agent.address, agent.parts.network.id)
        return agent

    def _report_account(self, role: str, address: str, zid: str) -> None:
        self._narrator.event(role, "account", f"account {address}, Zenoh id {zid}", address=address, zid=zid)

    def _add_handlers(self, robot: Agent) -> None:
        """Let the robot offer to do every demand for its model, and play objectives to its lamp."""
        robot.on("*")(Lamp(self._narrator).play)

        @robot.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            self._narrator.event(
                "robot",
                "demand",
                f"hears the Demand {demand.hash.hex()[:16]}… and publishes an Offer",
                demand=demand.hash.hex(),
                promisee=demand.signer,
            )
            await robot.offer(demand)

        @robot.on_liability
        async def phase(phase: Phase, liability: Liability) -> None:
            self._report_phase(phase, liability)

    def _report_match(self, match: Match) -> None:
        self._match = match
        self._narrator.event(
            "provider",
            "match",
            "Demand and Offer agree; asks the lighthouse for a contract",
            demand=match.demand.hash.hex(),
            offer=match.offer.hash.hex(),
        )

    def _report_phase(self, phase: Phase, liability: Liability) -> None:
        """Report the phases of the job, which the robot's ledger records."""
        event, address = self._narrator.event, liability.address
        match phase:
            case Phase.INCOMING:
                self._narrator.chapter("A contract holds the money")
                holds = f"liability {address} holds {_xrt(liability.cost)}"
                event("contract", "liability", holds, liability=address, cost=int(liability.cost))
                event("robot", "incoming", "fetches the objective by its CID and examines it", liability=address)
            case Phase.READY:
                event("robot", "ready", "is ready", liability=address)
            case Phase.RUNNING:
                self._narrator.chapter("The robot works")
                event("robot", "running", "plays the objective and records its device", liability=address)
            case Phase.COMPLETE:
                self._success = liability.is_success
                success, result = liability.is_success, liability.result
                words = f"signs the Result: {'done' if success else 'not done'}, recording\n{result}"
                event("robot", "complete", words, liability=address, result=result, success=success)
                self._narrator.chapter("The contract pays" if liability.is_success else "The contract refunds")
            case Phase.FINALIZED:
                event("contract", "finalized", "liability is finalized", liability=address)
                self._finalized.set()

    async def _do_job(self, objective: Objective, started: float) -> Contract:
        """Publish the demand, wait until the job is done and paid, and keep the recording."""
        before, path, event = await self._balances(), objective.path, self._narrator.event
        self._narrator.chapter("A person wants work done")
        cid = await asyncio.to_thread(cid_of_file, path)
        event("person", "objective", f"holds the objective {path.name}\n{cid}", objective=cid, file=str(path))
        event("person", "asking", f"will pay {_xrt(COST)} for it, and publishes a Demand", model=MODEL, cost=COST)
        async with asyncio.timeout(self._timeout):
            contract = await self._person.demand(path, cost=COST)
        async with asyncio.timeout(self._timeout + objective.duration_ns / 1e9 + objective.count * BLINK_SECONDS):
            outcome = await contract.outcome()
            await self._finalized.wait()
        recording, after = await contract.recording(), await self._balances()
        for role in ROLES:
            had, has = before[role], after[role]
            event(role, "balance", f"had {_xrt(had)}, has {_xrt(has)}", before=had, after=has)
        kept = await asyncio.to_thread(self._keep, recording, outcome.result, path, cid)
        event("person", "recording", f"has the recording {kept}\n{outcome.result}", result=outcome.result, path=kept)
        self._summarize(contract, outcome, cid, started)
        return contract

    async def _balances(self) -> dict[str, int]:
        chain = self._person.parts.chain
        return {role: await chain.tokens.balance(account.address) for role, account in self._market.accounts.items()}

    def _keep(self, recording: Path, result: str, objective: Path, cid: str) -> str:
        """Copy recording and objective to the output folder, named by their CIDs; return where the recording is."""
        if (out := self._out) is None:
            return f"{result}.mcap (keep it with --out DIR)"
        kept = out / f"{result}.mcap"
        for source, target in ((objective, out / f"{cid}{objective.suffix}"), (recording, kept)):
            try:
                shutil.copyfile(source, target)
            except shutil.SameFileError:
                continue  # the objective is one that an earlier demo kept
            except OSError as error:
                raise ConfigurationError(f"can't keep {target}: {error.strerror}", code="output-not-writable") from None
        return str(kept)

    def _summarize(self, contract: Contract, outcome: Outcome, objective: str, started: float) -> None:
        assert self._match is not None
        self._narrator.summary(
            liability=contract.address,
            demand=self._match.demand.hash.hex(),
            offer=self._match.offer.hash.hex(),
            objective=objective,
            result=outcome.result,
            success=self._success,
            paid=outcome.success,
            cost=COST,
            generation=self._generation,
            seconds=round(time.monotonic() - started, 3),
        )

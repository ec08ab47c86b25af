"""The project's compose files with real containers: a market, its jobs, and their events on its chain."""

from __future__ import annotations

import json
import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from web3 import HTTPProvider

from mesh.chain.answers import ANSWERS, decode_answer
from mesh.chain.following import ChainEvent, Finalized, NewLiability, Transfer, decode_log
from schemas import ZERO_ADDRESS, Empty, cid_of_file
from tests.support.compose import Project, log_text
from tests.support.containers import BASE_IMAGE, FOUNDRY_IMAGE
from tests.support.objectives import timed
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tests.support.containers import Engine

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "docker-compose.yml"
TWO_SITES = ROOT / "docker-compose.two-sites.yml"
MODEL = cid_of_file(ROOT / "examples/hello_mesh/model.md")
LAMP = "the lamp is on"
PAUSE = 0.3
"""Seconds between two questions to the engine: each is a process, which takes time from those that it asks after."""
COST = 7
"""XRT that a job costs."""

BUILD_SECONDS = 600.0
READY_SECONDS = 240.0
"""From nothing until the services of a market know each other, on a busy machine."""
CUT_SECONDS = 30.0
"""For which a service or a site is off its network."""
JOB_SECONDS = 180.0
"""Seconds for a job during a failure, in addition to the duration of its objective."""


@dataclass(frozen=True)
class Images:
    """The images of this tree, under a name of this run's own."""

    engine: Engine
    prefix: str

    @classmethod
    def build(cls, engine: Engine) -> Self:
        """Build them, on the host's network."""
        images = cls(engine, f"localhost/aira-test-{secrets.token_hex(4)}")
        for target in ("chain", "server", "edge"):
            bases = [f"--build-arg={name}" for name in (f"BASE={BASE_IMAGE}", f"FOUNDRY={FOUNDRY_IMAGE}")]
            words = ["build", "--network=host", f"--target={target}", *bases, f"--tag={images.name(target)}", str(ROOT)]
            engine(*words, seconds=BUILD_SECONDS)
        return images

    @property
    def variables(self) -> dict[str, str]:
        """The variables that name them in the compose file."""
        return {"MESH_IMAGE": self.prefix, "MESH_BASE_IMAGE": BASE_IMAGE, "MESH_FOUNDRY_IMAGE": FOUNDRY_IMAGE}

    def name(self, target: str) -> str:
        """The image of a target: edge, server or chain."""
        return f"{self.prefix}-{target}:latest"


class ComposeDeployment(Project):
    """The services of a compose file, all of the profile `demo`."""

    def __init__(self, images: Images, folder: Path, *, file: Path = COMPOSE) -> None:
        super().__init__(images.engine, folder, files=[file], profiles=["demo"], variables=images.variables)
        self._folder = folder

    async def ready(self) -> None:
        """Return when the demonstration's own job is done: all services have found each other."""
        await self.until(
            lambda: self.exit_code("person") is not None, what="the first job's end", seconds=READY_SECONDS
        )
        assert self.exit_code("person") == 0, self.report("the first job")

    def ask(self, seconds: int) -> Job:
        """A person asks for a job that plays for so long, a message a second, and waits for its end."""
        objective = self._folder / f"{seconds}.mcap"
        objective.write_bytes(timed(("/blink", Empty(), second * 10**9) for second in range(seconds + 1)))
        name = f"{self.name}_job_{secrets.token_hex(2)}"
        before = self.happened(Finalized)
        options = ["--detach", "--no-deps", "-T", f"--name={name}", f"--volume={objective}:/objective.mcap:ro"]
        demand = ["aira", "demand", "--json", f"--model={MODEL}", "--objective=/objective.mcap", f"--cost={COST}"]
        self.compose("run", *options, "person", *demand)
        return Job(self, name, seconds=seconds, before=before, lamps=self.lamps())

    async def until(self, condition: Callable[[], object], *, what: str, seconds: float) -> None:
        """Return when a condition is true; fail with the logs if it isn't within `seconds`."""
        try:
            await until(condition, what=what, seconds=seconds, pause=PAUSE)
        except AssertionError as error:
            raise AssertionError(self.report(str(error))) from None

    def lamps(self) -> int:
        """How often the robot's lamp went on so far."""
        return self.log("agent").count(LAMP)

    def account(self, role: str) -> str:
        """The address of robot or person, as the chain logs at its start."""
        (line,) = {line for line in self.log("chain").splitlines() if line.startswith(f"{role} ")}
        return line.split()[-1]

    def happened(self, *kinds: type[ChainEvent]) -> list[Any]:
        """All events of these kinds on the chain."""
        node = HTTPProvider(f"http://{self.address('chain')}:8545", request_kwargs={"timeout": 10})
        method: Any = "eth_getLogs"
        response = node.make_request(method, [{"fromBlock": "0x0", "toBlock": "latest"}])
        events = [decode_log(log) for log in decode_answer(method, response, ANSWERS[method])]
        return [event for event in events if isinstance(event, kinds)]

    def report(self, what: str) -> str:
        """The condition that was awaited and the end of every log, for the message of a failed test."""
        ends = [f"--- {name}\n{self.log_of(name)[-1500:]}" for name in self.containers()]
        return "\n".join([what, *ends])

    def log_of(self, container: str) -> str:
        """The log of a container."""
        return log_text(Path(self.engine.facts("inspect", container)[0]["LogPath"]))


async def passed(seconds: float) -> None:
    """Return after `seconds`: how long a failure lasts is part of the test."""
    began = time.monotonic()
    await until(lambda: time.monotonic() - began > seconds, what="the end of the failure", seconds=2 * seconds)


@dataclass(frozen=True)
class Job:
    """A person's container that waits for the end of a job. `before` and `lamps`: the state before it."""

    market: ComposeDeployment
    container: str
    seconds: int
    before: Sequence[Finalized]
    lamps: int

    async def is_played(self, messages: int = 2) -> None:
        """Return when the robot has played that many of its messages: the job is under way."""
        played = self.lamps + messages
        await self.market.until(lambda: self.market.lamps() >= played, what="its messages", seconds=JOB_SECONDS)

    def is_over(self) -> bool:
        """Whether the person's command has ended."""
        return self.market.engine("inspect", "--format", "{{.State.Status}}", self.container) == "exited\n"

    async def settled(self) -> dict[str, Any]:
        """Wait for the end, and check that the chain paid once and the right account; what the person printed."""
        await self.market.until(self.is_over, what="the job's end", seconds=self.seconds + JOB_SECONDS)
        said = self.market.log_of(self.container)
        code = self.market.engine("inspect", "--format", "{{.State.ExitCode}}", self.container)
        assert code == "0\n", self.market.report(said)
        *_, last = (line for line in said.splitlines() if line.startswith("{"))
        printed: dict[str, Any] = json.loads(last)
        (end,) = [event for event in self.market.happened(Finalized) if event not in self.before]
        assert (end.liability, end.success) == (printed["liability"], printed["success"])
        made = [event.liability for event in self.market.happened(NewLiability)]
        assert made.count(end.liability) == 1
        assert len(made) == len(self.before) + 1
        # What the same transaction mints is the provider's reward.
        paid = [
            event for event in self.market.happened(Transfer) if event.tx == end.tx and event.sender != ZERO_ADDRESS
        ]
        whose = self.market.account("robot" if end.success else "person")
        assert [(event.recipient, event.value) for event in paid] == [(whose, COST * 10**9)]
        return printed

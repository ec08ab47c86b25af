"""A market in the simulation: its chain, its router, its participants, and what was seen of them."""

from __future__ import annotations

import os
import traceback
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from mesh.chain import NoContracts, NotALiability
from mesh.errors import AiraError
from mesh.recording._mcap import McapWriter
from mesh.role.running import cause_of
from schemas import EMPTY, cid_of_file
from tests.simulation.chance import FaultDraw
from tests.simulation.deployment import ROBOTS, Deployed, MarketPlan
from tests.simulation.disk import SimulatedDisk
from tests.simulation.fault_plan import FaultPlan
from tests.simulation.roles import JurorRole, PersonRole, ProviderRole, RobotRole, Role
from tests.simulation.router import Router
from tests.simulation.scheduler import SECOND, Process, Scheduler
from tests.simulation.steps import StepAudit

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.market import Match
    from tests.simulation.audit import Audit

GONE: Final = (NoContracts, NotALiability)
"""Errors about contracts that a reorganisation may take: no process may end by them."""


@dataclass
class Market:
    """Everything in one history."""

    scheduler: Scheduler
    deployed: Deployed
    folder: Path
    jobs: int
    draw: FaultDraw = field(default_factory=FaultDraw)
    is_over: bool = False
    is_calm: bool = False
    """Whether all faults have stopped."""
    calm_since: int = 0
    """The block at which they stopped."""
    plan_crash: Callable[[Role, Process], None] = lambda role, process: None
    lines: list[str] = field(default_factory=list)
    audit: Audit | None = None
    whims: FaultPlan = field(default_factory=FaultPlan)
    """How often people and robots' owners do what they do by themselves."""
    settled_head: int = 0
    settled_blocks: int = 0
    plan: MarketPlan = field(default_factory=MarketPlan)

    def __post_init__(self) -> None:
        self.router = Router()
        self.router.faults.draw = self.draw
        self.deployed.chain.faults.draw = self.draw
        self.disk = SimulatedDisk(self.folder, self.draw)
        self.violations: list[str] = []
        self.objectives: dict[int, Path] = {}
        self.cids: dict[Path, str] = {}
        names = ("provider", "provider-1")[: self.plan.providers]
        self.providers = [ProviderRole(self, name) for name in names]
        self.robots = [RobotRole(self, f"robot-{number}") for number in range(ROBOTS)]
        people = self.plan.people
        share = [self.jobs // people + (number < self.jobs % people) for number in range(people)]
        self.people = [PersonRole(self, f"person-{number}", jobs) for number, jobs in enumerate(share) if jobs]
        self.jurors = [JurorRole(self, f"juror-{number}") for number in range(self.plan.jurors)]
        self.roles: list[Role] = [*self.providers, *self.robots, *self.people, *self.jurors]
        self.steps = StepAudit(self)
        self.router.tap = self.steps.sent
        self.router.asked = self.steps.asked
        self.deployed.chain.on_block = self.steps.block
        self.deployed.chain.most_in_block = self.plan.most_in_block

    def begin(self) -> None:
        """Start everything."""
        for role in self.roles:
            self.scheduler.call_later(self.scheduler.random.uniform(0, 5), role.start)
        self.scheduler.call_later(self.plan.block_seconds, self._mine)

    def _mine(self) -> None:
        if not self.is_over:
            self.deployed.chain.mine()
            self.scheduler.call_later(self.plan.block_seconds, self._mine)

    def trace(self, who: str, what: str, **facts: Any) -> None:
        """Note what happened; the trace of a seed is always the same."""
        said = " ".join(f"{name}={value}" for name, value in facts.items())
        self.lines.append(f"{self.scheduler.now_ns / SECOND:.6f} {who} {what} {said}".rstrip())

    def violated(self, invariant: str, detail: str) -> None:
        """An invariant does not hold."""
        self.trace("invariant", invariant, detail=detail)
        self.violations.append(f"{invariant}: {detail}")

    def ended(self, role: Role, error: BaseException) -> None:
        """A process ended by itself."""
        self.trace(role.name, "ended", error=_cause(error))
        if os.environ.get("AIRA_SIMULATION_TRACEBACKS"):
            traceback.print_exception(error)
        if isinstance(error, BaseExceptionGroup):
            error = cause_of(error) or error
        is_gone = (
            isinstance(error, GONE) and not self.draw.counts["answer-spoilt"]
        )  # which may say that nothing is there
        if not isinstance(error, AiraError) or is_gone:
            self.violated("process-died", f"{role.name}: {_cause(error)}")

    def matched(self, provider: str, match: Match) -> None:
        """A provider matched two orders."""
        self.trace(provider, "matched", demand=match.demand.hash.hex()[:12], offer=match.offer.hash.hex()[:12])
        self.steps.matched(provider, match)

    def fails(self, liability: str) -> bool:
        """Whether the device of this job is broken: some jobs fail, which refunds the promisee."""
        return int(liability, 16) % 7 == 0

    def objective(self, messages: int) -> Path:
        """An objective with so many messages."""
        if messages not in self.objectives:
            path = self.folder / f"objective-{messages}.mcap"
            with path.open("wb") as file:
                writer = McapWriter(file)
                channel = writer.channel("/blink", EMPTY, {})
                for number in range(messages):
                    writer.write(channel, b"", number * self.plan.step_ns, number * self.plan.step_ns)
                writer.finish()
            self.objectives[messages], self.cids[path] = path, cid_of_file(path)
        return self.objectives[messages]


def _cause(error: BaseException) -> str:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = "" if trace is None else f" at {trace.tb_frame.f_code.co_filename.rsplit('/aira', 1)[-1]}:{trace.tb_lineno}"
    return f"{type(error).__name__}: {error}{where}"

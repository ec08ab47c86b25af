"""One history: a market from its beginning until all jobs have ended, under one seed."""

from __future__ import annotations

import hashlib
import math
import os
import random
import shutil
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tests.simulation import loop, threads
from tests.simulation.audit import Audit
from tests.simulation.chance import FaultDraw
from tests.simulation.deployment import JOBS, PAUSES, market_plan
from tests.simulation.fault_plan import choose
from tests.simulation.faults import Faults
from tests.simulation.market import Market
from tests.simulation.scheduler import REAL_TIME, SECOND, HistoryFailed, Process

if TYPE_CHECKING:
    from tests.simulation.deployment import Deployed
    from tests.simulation.fault_plan import FaultPlan

CHAOS_SECONDS: Final = 400
"""How long faults happen, for each job of a person."""
CALM_SECONDS: Final = 900
"""How long everything has after that to end, for each job of a person: within it accepted jobs are paid or refunded."""
FOLDER: Final = Path("/dev/shm" if Path("/dev/shm").is_dir() else tempfile.gettempdir()) / "aira-simulation"


@dataclass
class Report:
    """What happened in a history."""

    seed: int
    jobs: int = 0
    paid: int = 0
    refunded: int = 0
    lost: int = 0
    """Jobs whose contract has not ended."""
    paid_twice: int = 0
    violations: list[str] = field(default_factory=list)
    faults: dict[str, int] = field(default_factory=dict)
    chains: dict[str, int] = field(default_factory=dict)
    """Histories by what ran the contracts: the `model` or the `evm`."""
    markets: dict[str, int] = field(default_factory=dict)
    """Histories whose market had something more than a plain one."""
    simulated_s: float = 0.0
    real_s: float = 0.0
    cpu_s: float = 0.0
    drawn: int = 0
    """Faults that happened in the history of the report, and were left out."""
    trace: str = ""
    """The hash of the trace."""


def plan_of(
    seed: int, jobs: int, *, only: frozenset[str] | None = None, without: frozenset[str] = frozenset()
) -> FaultPlan:
    """The faults of a seed, of some kinds `only`, or `without` some. In long histories they last longer."""
    plan = choose(random.Random(f"faults {seed}"), only=only, without=without)
    plan.lasts *= max(1.0, jobs / JOBS / market_plan(seed, jobs).at_once)
    return plan


def run_history(
    deployed: Deployed,
    seed: int,
    jobs: int,
    plan: FaultPlan,
    *,
    left_out: frozenset[int] = frozenset(),
    switches: str | None = None,
) -> tuple[Report, list[str]]:
    """Run the history of a seed with these faults, but those with the numbers `left_out`; its report and its trace.

    Each switch of threads is written to the file `switches`: where two runs of a seed differ, it shows where it begins.
    """
    began, cpu = REAL_TIME(), time.process_time()
    scheduler = threads.begin(seed)
    scheduler.now_ns = 2_000 * SECOND
    if switches:
        scheduler.watch_switches(Path(switches))
    # Relative, so that the paths are the same in each run.
    folder = FOLDER / str(os.getpid())
    shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed and had the same number
    folder.mkdir(parents=True)
    os.chdir(folder)
    try:
        draw = FaultDraw(seed, left_out)
        market = Market(scheduler, deployed, Path("market"), jobs, draw, plan=market_plan(seed, jobs))
        market.folder.mkdir()
        CURRENT[:] = [market.router]
        try:
            _play(market, plan)
        except HistoryFailed as failure:
            market.violated("history-failed", str(failure))
        for name, error in scheduler.failures:
            market.violated("thread-died", f"{name}: {error!r}")
        report = _report(market, seed)
    finally:
        os.chdir("/")
        shutil.rmtree(folder)
    report.real_s, report.cpu_s = round(REAL_TIME() - began, 3), round(time.process_time() - cpu, 3)
    return report, market.lines


def _play(market: Market, plan: FaultPlan) -> None:
    scheduler = market.scheduler
    market.disk.install()
    faults = Faults(market, plan)
    market.begin()
    faults.start()
    most = math.ceil(max(person.wanted for person in market.people) / market.plan.at_once)
    pause = market.plan.pause - PAUSES[0]
    chaos = plan.lasts or (CHAOS_SECONDS + pause) * most
    scheduler.run(
        lambda: all(person.is_done for person in market.people), until_ns=scheduler.now_ns + round(chaos * SECOND)
    )
    faults.stop()
    market.calm_since = market.deployed.chain.evm.head
    market.trace("faults", "stopped", block=market.calm_since)
    audit = market.audit = Audit(market)
    calm = (CALM_SECONDS + pause) * max(most, 2)  # crowded markets with few jobs: longer than the refund delay
    scheduler.run(lambda: _is_settled(market, audit), until_ns=scheduler.now_ns + round(calm * SECOND))
    for person in market.people:
        for order in person.orders:
            if not order.is_over:
                market.violated("not-told", f"{order.person} waits for job {order.number} ({order.told or 'ordered'})")
    errors: list[BaseException | None] = []
    loop.start(scheduler, Process(scheduler, "audit"), audit.promises, errors.append)
    scheduler.run(lambda: bool(errors), until_ns=scheduler.now_ns + 3600 * SECOND)
    if errors and errors[0] is not None:
        raise errors[0]
    audit.money()
    for difference in audit.ledgers():
        market.violated("ledger-differs", difference)
    audit.liveness()
    for address in sorted(audit.open):
        market.violated("not-finalized", address)
    market.is_over = True


def _is_settled(market: Market, audit: Audit) -> bool:
    """Whether people know everything and all liabilities have ended, for some blocks, and ledgers have it all."""
    head = market.deployed.chain.evm.head
    if head == market.settled_head:
        return False
    market.settled_head = head
    done = all(person.is_done for person in market.people) and all(audit.liabilities().values())
    if done and market.settled_blocks == SETTLED_BLOCKS and any(audit.ledgers()):
        return False
    market.settled_blocks = market.settled_blocks + 1 if done else 0
    return market.settled_blocks > SETTLED_BLOCKS


SETTLED_BLOCKS: Final = 5


def _report(market: Market, seed: int) -> Report:
    orders = [order for person in market.people for order in person.orders]
    audit = market.audit
    report = Report(seed, jobs=len(orders), violations=market.violations, drawn=market.draw.drawn)
    if audit is not None:
        report.paid, report.refunded, report.lost = len(audit.paid), len(audit.refunded), len(audit.open)
        report.paid_twice = audit.paid_twice
    counts = market.draw.counts
    counts["reorganisation-blocks"] = market.deployed.chain.deepest
    report.faults = {kind: count for kind, count in sorted(counts.items()) if count}
    report.markets = dict.fromkeys(market.plan.kinds, 1)
    report.simulated_s = round(market.scheduler.now_ns / SECOND - 2_000, 3)
    report.trace = hashlib.sha256("\n".join(market.lines).encode()).hexdigest()
    return report


CURRENT: list[object] = []
"""The router to which sessions are opened."""

"""What goes wrong in a history: chosen by its seed, with few kinds in some histories and many in others."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

from tests.simulation.scheduler import SECOND

if TYPE_CHECKING:
    import random

    from tests.simulation.market import Market
    from tests.simulation.roles import Role
    from tests.simulation.scheduler import Process

MOST_BLOCKS: Final = 12
"""The deepest reorganisation: what production remembers by default."""
SHARES: Final = (0.0, 0.3, 0.3, 0.6)
"""How many of the kinds a history has: none in some."""
HOUR_NS: Final = 3600 * SECOND


@dataclass
class FaultPlan:
    """How often each kind happens. Intervals are mean seconds, zero is never; the others are probabilities."""

    drop: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0
    replay: float = 0.0
    """That a message arrives again, up to minutes later: anybody may repeat what is signed."""
    partition_every: float = 0.0
    router_every: float = 0.0
    crash: float = 0.0
    """That a process crashes at one of its first steps or commits; it is asked again at each start."""
    crash_every: float = 0.0
    reorganise_every: float = 0.0
    forget: float = 0.0
    leave_out: float = 0.0
    price_every: float = 0.0
    unreachable: float = 0.0
    silent: float = 0.0
    late: float = 0.0
    spoilt: float = 0.0
    lost_after_sending: float = 0.0
    outage_every: float = 0.0
    clock_every: float = 0.0
    full_every: float = 0.0
    """Disks that are full for a while."""
    leave: float = 0.0
    """That a robot leaves for good; another one stays."""
    preempt: float = 0.0
    lasts: float = 0.0
    """Seconds after which all faults stop, though people go on; zero: not before people are done, or time is up."""


RANGES: Final[dict[str, tuple[float, float]]] = {
    "drop": (0.02, 0.4),
    "duplicate": (0.05, 0.5),
    "delay": (0.05, 0.5),
    "replay": (0.05, 0.5),
    "partition_every": (30, 300),
    "router_every": (100, 600),
    "crash": (0.1, 0.7),
    "crash_every": (30, 400),
    "reorganise_every": (15, 200),
    "forget": (0.01, 0.1),
    "leave_out": (0.05, 0.5),
    "price_every": (100, 600),
    "unreachable": (0.01, 0.2),
    "silent": (0.001, 0.01),
    "late": (0.01, 0.2),
    "spoilt": (0.002, 0.03),
    "lost_after_sending": (0.05, 0.3),
    "outage_every": (60, 400),
    "clock_every": (2, 200),
    "full_every": (30, 300),
    "leave": (0.3, 1.0),
    "preempt": (0.01, 0.1),
}


KINDS: Final = tuple(field.name for field in fields(FaultPlan) if field.name in RANGES)
LASTS: Final = (10, 150)


def choose(
    chance: random.Random, *, only: frozenset[str] | None = None, without: frozenset[str] = frozenset()
) -> FaultPlan:
    """The faults of a history: all of the kinds in `only`, or of all kinds but `without` some."""
    plan, level = FaultPlan(), chance.choice(SHARES) if only is None else 1.0
    for name in KINDS:
        is_chosen, value = chance.random() < level, chance.uniform(*RANGES[name])
        if is_chosen and (only is None or name in only) and name not in without:
            setattr(plan, name, value)
    plan.lasts = chance.choice([0.0, chance.uniform(*LASTS)])
    return plan


class Faults:
    """Makes the faults of a plan happen in a market, until `stop`."""

    def __init__(self, market: Market, plan: FaultPlan) -> None:
        self._market = market
        self._scheduler = market.scheduler
        self._plan = plan
        self._draw = market.draw
        market.plan_crash = self._plan_crash

    def start(self) -> None:
        """Begin."""
        market, plan = self._market, self._plan
        transport, mining = market.router.faults, market.deployed.chain.faults
        transport.drop, transport.duplicate, transport.delay = plan.drop, plan.duplicate, plan.delay
        transport.replay = plan.replay
        mining.forget, mining.leave_out = plan.forget, plan.leave_out
        self._scheduler.preempt = plan.preempt
        for faults in (faults for role in market.roles for faults in role.all_node_faults):
            faults.unreachable, faults.silent, faults.late = plan.unreachable, plan.silent, plan.late
            faults.spoilt, faults.lost_after_sending = plan.spoilt, plan.lost_after_sending
        if self._draw("robot-left", plan.leave):
            self._scheduler.call_later(self._draw.random.uniform(5, 300), self._leave)
        every = {
            self._partition: plan.partition_every,
            self._router: plan.router_every,
            self._crash: plan.crash_every,
            self._reorganise: plan.reorganise_every,
            self._price: plan.price_every,
            self._outage: plan.outage_every,
            self._clock: plan.clock_every,
            self._fill: plan.full_every,
        }
        for fault, mean in every.items():
            if mean:
                self._later(mean, fault, mean)

    def stop(self) -> None:
        """No more faults: what was broken works again."""
        market = self._market
        market.is_calm = True
        faults, mining = market.router.faults, market.deployed.chain.faults
        faults.drop = faults.duplicate = faults.delay = faults.replay = 0.0
        mining.forget = mining.leave_out = 0.0
        mining.price_factor = 1.0
        self._scheduler.preempt = 0.0
        market.disk.full.clear()
        market.router.set_up(True)
        for session in market.router.sessions:
            session.set_linked(True)
        for role in market.roles:
            for node_faults in role.all_node_faults:
                node_faults.stop()
            if role.process is not None:
                role.process.crash_at_step = role.process.crash_at_commit = None

    def _later(self, mean: float, fault: object, *arguments: object) -> None:
        assert callable(fault)
        self._scheduler.call_later(self._draw.random.expovariate(1 / mean), fault, *arguments)

    def _again(self, fault: object, mean: float, kind: str) -> bool:
        """Whether the fault happens now; the next one is planned, while there are faults."""
        if self._market.is_calm:
            return False
        self._later(mean, fault, mean)
        return self._draw(kind)

    def _plan_crash(self, role: Role, process: Process) -> None:
        chance = self._draw.random
        if self._draw("crash-planned", self._plan.crash):
            if chance.random() < 0.6:
                process.crash_at_step = int(chance.lognormvariate(5.5, 1.5)) + 1
            else:
                process.crash_at_commit = chance.randint(1, 60)

    def _leave(self) -> None:
        robot = self._market.robots[-1]
        if not self._market.is_calm:
            robot.has_left = True
            self._market.trace(robot.name, "leaves")
            robot.crash()

    def _crash(self, mean: float) -> None:
        if self._again(self._crash, mean, "crash"):
            self._draw.random.choice(self._market.roles).crash()

    def _partition(self, mean: float) -> None:
        sessions = self._market.router.sessions
        if self._again(self._partition, mean, "partition") and sessions:
            session = self._draw.random.choice(sessions)
            session.set_linked(False)
            self._scheduler.call_later(self._draw.random.uniform(1, 60), session.set_linked, True)

    def _router(self, mean: float) -> None:
        if self._again(self._router, mean, "router-restart"):
            self._market.router.set_up(False)
            self._scheduler.call_later(self._draw.random.uniform(1, 60), self._market.router.set_up, True)

    def _reorganise(self, mean: float) -> None:
        if self._again(self._reorganise, mean, "reorganisation"):
            chance = self._draw.random
            depth = chance.choice([1, 1, 1, 2, 2, 3, chance.randint(1, MOST_BLOCKS)])
            chain = self._market.deployed.chain
            before = chain.evm.head
            chain.reorganise(depth, forget=chance.choice([0.0, 0.0, 0.3, 1.0]))
            self._market.trace("chain", "reorganised", depth=depth, head=f"{before}->{chain.evm.head}")

    def _price(self, mean: float) -> None:
        if self._again(self._price, mean, "gas-price"):
            faults, chance = self._market.deployed.chain.faults, self._draw.random
            faults.price_factor = chance.choice([1.5, 3, 20, 2000])
            self._scheduler.call_later(chance.uniform(10, 200), setattr, faults, "price_factor", 1.0)

    def _outage(self, mean: float) -> None:
        if self._again(self._outage, mean, "node-outage"):
            chance = self._draw.random
            faults = chance.choice(self._market.roles).node_faults
            before, faults.unreachable = faults.unreachable, 1.0
            ends = min(before, 0.9)
            self._scheduler.call_later(chance.uniform(5, 120), self._outage_over, faults, ends)

    def _outage_over(self, faults: object, before: float) -> None:
        faults.unreachable = 0.0 if self._market.is_calm else before  # type: ignore[attr-defined]

    def _clock(self, mean: float) -> None:
        if self._again(self._clock, mean, "clock-jump"):
            chance = self._draw.random
            role = chance.choice(self._market.roles)
            role.wall_offset_ns += chance.choice([-HOUR_NS, HOUR_NS, -SECOND, 24 * HOUR_NS])
            if role.process is not None:
                role.process.wall_offset_ns = role.wall_offset_ns

    def _fill(self, mean: float) -> None:
        if self._again(self._fill, mean, "disk-full"):
            chance, disk = self._draw.random, self._market.disk
            name = chance.choice(self._market.roles).name
            disk.full.add(name)
            self._market.trace(name, "disk-full")
            self._scheduler.call_later(chance.uniform(1, 60), disk.full.discard, name)

"""Makes what a `FaultPlan` says go wrong in a history."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tests.simulation.scheduler import SECOND

if TYPE_CHECKING:
    from tests.simulation.fault_plan import FaultPlan
    from tests.simulation.market import Market
    from tests.simulation.roles import Role
    from tests.simulation.scheduler import Process

MOST_BLOCKS: Final = 12
"""The deepest reorganisation: what production remembers by default."""
HOUR_NS: Final = 3600 * SECOND
TOGETHER: Final = 0.4
"""How probable it is that one fault brings another with it."""
TOGETHER_SECONDS: Final = 20.0
"""Within how long."""
MOST_REPEATED: Final = 200
"""Orders that a stranger publishes again at once, at most."""


class Faults:
    """Makes the faults of a plan happen in a market, until `stop`."""

    def __init__(self, market: Market, plan: FaultPlan) -> None:
        self._market = market
        self._scheduler = market.scheduler
        self._plan = plan
        self._draw = market.draw
        market.plan_crash = self._plan_crash
        self._reorganisations = market.deployed.chain.reorganisations

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
        market.whims = plan
        if self._draw("robot-left", plan.leave):
            self._scheduler.call_later(self._draw.random.uniform(5, 300), self._leave)
        self._every = {
            kind: (mean, fault)
            for kind, mean, fault in (
                ("partition", plan.partition_every, self._partition),
                ("router-restart", plan.router_every, self._restart_router),
                ("crash", plan.crash_every, self._crash),
                ("reorganisation", plan.reorganise_every, self._reorganise),
                ("gas-price", plan.price_every, self._raise_price),
                ("node-outage", plan.outage_every, self._end_node),
                ("clock-jump", plan.clock_every, self._set_clock),
                ("disk-full", plan.full_every, self._fill),
                ("orders-repeated", plan.repeat_every, self._repeat_orders),
            )
            if mean
        }
        for kind, (mean, _) in self._every.items():
            self._scheduler.call_later(self._draw.random.expovariate(1 / mean), self._again, kind, mean)
        if plan.reorganise_after:
            self._checked, self._check_block = market.deployed.chain.evm.head, market.deployed.chain.on_block
            market.deployed.chain.on_block = self._block
        if plan.repeat_every:
            self._stranger = market.router.open()

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
            role.wall_offset_ns = 0
            if role.process is not None:
                role.process.wall_offset_ns = 0
                role.process.crash_at_step = role.process.crash_at_commit = None

    def _again(self, kind: str, mean: float) -> None:
        """A fault happens, and the next one of its kind is planned, while there are faults."""
        if not self._market.is_calm:
            self._scheduler.call_later(self._draw.random.expovariate(1 / mean), self._again, kind, mean)
            self._happen(kind)

    def _happen(self, kind: str) -> None:
        """A fault happens; perhaps it brings another one with it."""
        if not self._market.is_calm and self._draw(kind):
            self._every[kind][1]()
            self._bring_another()

    def _bring_another(self) -> None:
        chance = self._draw.random
        if self._every and chance.random() < TOGETHER:
            other = chance.choice(list(self._every))
            self._scheduler.call_later(chance.uniform(0, TOGETHER_SECONDS), self._happen, other)

    def _block(self) -> None:
        """A block was mined, or some were replaced."""
        chain = self._market.deployed.chain
        self._check_block()
        head, reorganisations = chain.evm.head, chain.reorganisations
        first, self._checked = min(self._checked, head - 1) + 1, head
        is_new = reorganisations == self._reorganisations and any(chain.evm.logs(first, head))
        self._reorganisations = reorganisations
        if is_new and not self._market.is_calm and self._draw("event-replaced", self._plan.reorganise_after):
            self._scheduler.call_later(
                self._draw.random.uniform(0, self._market.plan.block_seconds), self._replace, first
            )

    def _replace(self, first: int) -> None:
        chain, chance = self._market.deployed.chain, self._draw.random
        if not self._market.is_calm:
            depth = chain.evm.head - first + 1 + chance.choice([0, 0, 1, 3])
            chain.reorganise(min(depth, MOST_BLOCKS), forget=chance.choice([0.0, 0.5, 1.0]))
            self._market.trace("chain", "replaced", depth=depth, head=chain.evm.head)
            self._bring_another()

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

    def _crash(self) -> None:
        self._draw.random.choice(self._market.roles).crash()

    def _partition(self) -> None:
        sessions = self._market.router.sessions
        if sessions:
            session = self._draw.random.choice(sessions)
            session.set_linked(False)
            self._scheduler.call_later(self._draw.random.uniform(1, 60), session.set_linked, True)

    def _restart_router(self) -> None:
        self._market.router.set_up(False)
        self._scheduler.call_later(self._draw.random.uniform(1, 60), self._market.router.set_up, True)

    def _reorganise(self) -> None:
        chance = self._draw.random
        depth = chance.choice([1, 1, 1, 2, 2, 3, chance.randint(1, MOST_BLOCKS)])
        chain = self._market.deployed.chain
        before = chain.evm.head
        chain.reorganise(depth, forget=chance.choice([0.0, 0.0, 0.3, 1.0]))
        self._market.trace("chain", "reorganised", depth=depth, head=f"{before}->{chain.evm.head}")

    def _raise_price(self) -> None:
        faults, chance = self._market.deployed.chain.faults, self._draw.random
        faults.price_factor = chance.choice([1.5, 3, 20, 2000])
        self._scheduler.call_later(chance.uniform(10, 200), setattr, faults, "price_factor", 1.0)

    def _end_node(self) -> None:
        chance = self._draw.random
        faults = chance.choice(self._market.roles).node_faults
        before, faults.unreachable = faults.unreachable, 1.0
        ends = min(before, 0.9)
        self._scheduler.call_later(chance.uniform(5, 120), self._outage_over, faults, ends)

    def _outage_over(self, faults: object, before: float) -> None:
        faults.unreachable = 0.0 if self._market.is_calm else before  # type: ignore[attr-defined]

    def _set_clock(self) -> None:
        chance = self._draw.random
        role = chance.choice(self._market.roles)
        role.wall_offset_ns += chance.choice([-HOUR_NS, HOUR_NS, -SECOND, 24 * HOUR_NS])
        if role.process is not None:
            role.process.wall_offset_ns = role.wall_offset_ns

    def _fill(self) -> None:
        chance, disk = self._draw.random, self._market.disk
        name = chance.choice(self._market.roles).name
        disk.full.add(name)
        self._market.trace(name, "disk-full")
        self._scheduler.call_later(chance.uniform(1, 60), disk.full.discard, name)

    def _repeat_orders(self) -> None:
        """What is signed anybody may publish again, at any time."""
        orders = list(self._market.steps.orders.values())
        if len(orders) > MOST_REPEATED:
            orders = self._draw.random.sample(orders, MOST_REPEATED)
        for sample in orders:
            self._market.router.publish(sample, self._stranger)

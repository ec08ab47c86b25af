"""The invariants: what must hold after every history, whatever went wrong in it."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from contextlib import closing
from typing import TYPE_CHECKING, Final

from mesh.agent.ledger import Phase
from mesh.chain import Chain, Finalized, NewLiability, Transfer
from mesh.validator.verification import Claim, JobFiles, verify
from schemas import ZERO_ADDRESS
from tests.simulation.chain import NodeFaults, SimulatedNode
from tests.simulation.faults import MOST_BLOCKS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mesh.agent.ledger import JobRecord
    from mesh.chain import ChainEvent
    from schemas import Liability
    from tests.simulation.market import Market
    from tests.simulation.roles import Ordered, Role

INVALID: Final = frozenset(
    {
        *("played", "sequence", "statistics", "readable", "result-file", "objective-file", "signature"),
        *("times", "roles", "clock"),
    }
)
"""The findings of `aira verify` that no job of an honest robot may have."""
MATCHED_WITHIN: Final = 40
"""Blocks without faults within which an open order becomes a contract, if there are robots."""
DEARER_WITHIN: Final = 2
"""In generation 5: blocks more for each order that costs more, and becomes a contract meanwhile."""
DONE_WITHIN: Final = 70
"""Blocks without faults within which a robot's result is on the chain. The refund delay is longer."""


class Audit:
    """Checks a market that has come to rest."""

    def __init__(self, market: Market) -> None:
        self._market = market
        self._chain = market.deployed.chain
        self.paid: set[str] = set()
        self.refunded: set[str] = set()
        self.open: set[str] = set()
        self.paid_twice = 0
        self._promisors: dict[str, str] = {}

    def _events(self) -> list[ChainEvent | None]:
        """All events on the chain."""
        return self._chain.events(self._chain.began + 1, self._chain.evm.head)

    def liabilities(self) -> dict[str, Finalized | None]:
        """All liabilities on the chain, with how they ended."""
        found: dict[str, Finalized | None] = {}
        for event in self._events():
            if isinstance(event, NewLiability):
                found.setdefault(event.liability, None)
            elif isinstance(event, Finalized):
                if found.get(event.liability) is not None:
                    self._market.violated("finalized-twice", event.liability)
                found[event.liability] = event
        return found

    def money(self) -> None:
        """Tokens are conserved, and each liability has paid what it got, once, to one account."""
        balance: dict[str, int] = defaultdict(int)
        payouts: dict[str, list[Transfer]] = defaultdict(list)
        liabilities = self.liabilities()
        for event in self._events():
            if isinstance(event, Transfer):
                balance[event.sender] -= event.value
                balance[event.recipient] += event.value
                if event.sender in liabilities and event.value:
                    payouts[event.sender].append(event)
        for liability, finalized in liabilities.items():
            if finalized is None:
                self.open.add(liability)
            else:
                (self.paid if finalized.success else self.refunded).add(liability)
            if balance[liability] and finalized is not None:
                self._market.violated("tokens-not-conserved", f"{liability} keeps {balance[liability]} wn")
            if len(payouts[liability]) > 1:
                self.paid_twice += 1
                self._market.violated("paid-twice", f"{liability}: {payouts[liability]}")
        if sum(amount for account, amount in balance.items() if account != ZERO_ADDRESS) != -balance[ZERO_ADDRESS]:
            self._market.violated("tokens-not-conserved", "sent and received amounts differ")

    async def promises(self) -> None:
        """What people were told has happened, and nobody paid for an order that they believed dead.

        People are told after one confirmation, so a reorganisation may contradict that. A payment that it reverts is
        made again, unless the robot has left for good (only the robot is sure to keep its result), or the payment came,
        or the faults ended, so late that a refund may be mined instead. Instead of a refund that it reverts, a payment
        may be mined.
        """
        node = SimulatedNode(self._chain, NodeFaults())
        self._market.steps.attempts.at_end()
        told = {order.contract: order for person in self._market.people for order in person.orders if order.contract}
        dead = {
            order.order: order
            for person in self._market.people
            for order in person.orders
            if order.order and order.is_dead
        }
        async with Chain(node, contracts=self._market.deployed.market.deployment.contracts) as chain:
            for address in self.liabilities():
                demand, _ = (await chain.liabilities.get_with_orders(address))[1]
                if (believed := dead.get(demand.hex())) is not None and not self._chain.reorganisations:
                    self._market.violated("promise-broken", f"{believed.person} was told {believed.told!r}; {address}")
                record = await chain.liabilities.get(address)
                self._promisors[address] = record.promisor
                if (order := told.get(address)) is not None:
                    self._told(order, record, refundable_from=await chain.liabilities.refundable_from(address))
                if record.is_finalized and record.is_success:
                    if self._market.fails(address):
                        self._market.violated("failed-job-paid", address)
                    self._evidence(record)
        liabilities = self.liabilities()
        for address, order in told.items():
            is_gone = order.told in ("paid", "refunded") and address not in liabilities
            if is_gone and not self._chain.reorganisations:
                self._market.violated("promise-broken", f"{order.person} was told {order.told!r}; {address} is gone")

    def jobs_of(self, robot: Role) -> set[str]:
        """The liabilities of a robot."""
        return {address for address, promisor in self._promisors.items() if promisor == robot.account.address}

    def _told(self, order: Ordered, record: Liability, *, refundable_from: int) -> None:
        told = order.told
        if told in ("paid", "refunded") and (told == "paid") != record.is_success:
            done = max(order.told_block + MOST_BLOCKS, self._market.calm_since + DONE_WITHIN)
            is_late = done >= refundable_from
            if told == "paid" and self._chain.reorganisations and (is_late or self._has_left(record.promisor)):
                return
            if told == "refunded" and order.told_ns < self._market.steps.reorganised_ns:
                return
            detail = f"{record.address}: told {told!r}, but success is {record.is_success}"
            self._market.violated("promise-broken", detail)

    def _has_left(self, account: str) -> bool:
        return any(robot.has_left for robot in self._market.robots if robot.account.address == account)

    def _evidence(self, record: Liability) -> None:
        """A success has a complete recording, which the robot still has."""
        robot = next(one for one in self._market.robots if one.account.address == record.promisor)
        store = next(iter(sorted(robot.folder.rglob("content"))), None)
        recording = None if store is None else _file(store, record.result)
        if recording is None:
            self._market.violated("recording-missing", f"{record.address}: {record.result}")
            return
        objective = next(
            path for path in self._market.objectives.values() if self._market.cids[path] == record.objective
        )
        files = JobFiles(
            objective=objective, result=recording, objective_cid=record.objective, result_cid=record.result
        )
        verdict = verify(Claim.of_contract(record), files)
        for finding in verdict.findings:
            is_open = finding.name == "played" and finding.holds is None
            if is_open or (finding.holds is False and finding.name in INVALID):
                self._market.violated("recording-incomplete", f"{record.address} {finding.name}: {finding.detail}")

    def liveness(self) -> None:
        """Without faults, orders that stay open are matched, and robots bring their results before the refund."""
        calm, blocks = self._market.calm_since, self._blocks()
        left = [robot for robot in self._market.robots if robot.has_left]
        gone = {address for robot in left for address in self.jobs_of(robot)}
        for person in self._market.people:
            for order in person.orders:
                if self._market.steps.attempts.robots.get(order.order) in {robot.account.address for robot in left}:
                    continue
                open_for = order.deadline - max(order.posted, calm)
                patience = MATCHED_WITHIN + DEARER_WITHIN * self._dearer(order)
                if order.told == "expired" and open_for >= patience:
                    detail = f"{person.name} waited {open_for} blocks without faults for {order.order[:12]}"
                    self._market.violated("order-starved", detail)
        for address, (created, ended, result) in blocks.items():
            if address not in gone and ended and not result and ended - max(created, calm) >= DONE_WITHIN:
                self._market.violated("job-abandoned", f"{address}: {ended - max(created, calm)} blocks without faults")

    def _dearer(self, order: Ordered) -> int:
        """In generation 5, the orders that cost more than this one and became contracts before it expired.

        The nonces of an account count: of its orders, and of a robot's offers, one becomes a contract at a time.
        """
        if self._market.plan.generation == 3:
            return 0
        others = (one for person in self._market.people for one in person.orders if one.contract)
        return sum(
            one.cost > order.cost and order.posted < one.told_block and one.posted < order.deadline for one in others
        )

    def _blocks(self) -> dict[str, tuple[int, int, str]]:
        """Of each liability: in which block it was created, in which it ended (0: in none), and with what result."""
        found: dict[str, tuple[int, int, str]] = {}
        for number in range(self._chain.began + 1, self._chain.evm.head + 1):
            for event in self._chain.events(number, number):
                if isinstance(event, NewLiability):
                    found[event.liability] = (number, 0, "")
                elif isinstance(event, Finalized) and event.liability in found:
                    found[event.liability] = (found[event.liability][0], number, event.result)
        return found

    def ledgers(self) -> Iterator[str]:
        """Where a robot's ledger says something else of its jobs than the chain."""
        ended = self.liabilities()
        for robot in self._market.robots:
            if robot.has_left:
                continue
            jobs = {job.liability.address: job for job in _jobs(robot.folder)}
            for address, job in jobs.items():
                is_ended = ended.get(address) is not None
                if address not in ended:
                    yield f"{robot.name} has {address}, which is not on the chain"
                elif (job.phase is Phase.FINALIZED) != is_ended:
                    yield f"{robot.name} {address} is {job.phase}, ended {is_ended}"


def _jobs(folder: Path) -> list[JobRecord]:
    from mesh.agent.ledger import _job

    found: list[JobRecord] = []
    for path in sorted(folder.rglob("ledger.sqlite")):
        with closing(sqlite3.connect(path)) as database:
            found += [_job(row) for row in database.execute("SELECT * FROM jobs WHERE NOT aside")]
    return found


def _file(store: Path, cid: str) -> Path | None:
    return next((path for path in sorted(store.rglob(cid)) if path.is_file()), None)

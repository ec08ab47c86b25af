"""The invariants of orders for one robot, of jobs that were stopped or handed back, and of those ordered again."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Final

from eth_utils.crypto import keccak

from schemas import InvalidRecord
from schemas.messages import message_hash
from schemas.rpc import AcceptDemand, OrderPair
from schemas.signing import StopRequest
from tests.simulation.scheduler import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from schemas import Demand
    from tests.simulation.market import Market
    from tests.simulation.roles import PersonRole
    from tests.simulation.steps import StepAudit

PROMISOR: Final = keccak(text="promisor()")[:4].hex()
CALLED_OFF_NS: Final = 10 * SECOND
"""For how long a further attempt may be on its way to the market when a person stops a job that has failed."""


class AttemptAudit:
    """Watches what people demand, whom they ask for it, and what was stopped. `call` reads a view of a contract."""

    def __init__(self, market: Market, steps: StepAudit, call: Callable[[str, str], bytes]) -> None:
        self._market = market
        self._steps = steps
        self._call = call
        self.robots: dict[str, str] = {}
        """Of each demand (hash) for one robot alone: its address."""
        self._lasting: dict[str, str] = {}
        """What all versions of a demand share, by the hash of each."""
        self._sent: dict[tuple[PersonRole, int], list[str]] = {}
        """The attempts at each job that a person wanted, by what their versions share, the first one first."""
        self._stopped: dict[str, str] = {}
        """The liabilities whose robot has said that their jobs are stopped, or handed back, and by whom."""
        self._too_late: set[str] = set()
        """The liabilities of further attempts that were made after their person had stopped the job."""
        self._asked_to_stop: set[str] = set()
        """The liabilities whose robot was asked to stop by their person."""

    def asked(self, key: str, payload: bytes) -> Demand | None:
        """A person asks a robot for its offer, or to stop, or a provider to take a pair; the demand of that."""
        with suppress(InvalidRecord):
            if key.endswith("/accept"):
                request = AcceptDemand.decode(payload)
                self.robots[message_hash(request.demand.message()).hex()] = request.robot
            elif key.endswith("/pair"):
                demand: Demand = OrderPair.decode(payload).demand.message()
                return demand
            elif key.endswith("/stop"):
                self._asked_to_stop.add(StopRequest.decode(payload).liability)
        return None

    def sent(self, maker: tuple[PersonRole, int], demand: str, lasting: str) -> None:
        """A demand was sent for a job: the first one, a further version of it, or that of a further attempt."""
        sent = self._sent.setdefault(maker, [])
        self._lasting[demand] = lasting
        if lasting in sent:
            return
        person, number = maker
        order, which = person.orders[number], f"{person.name}'s job {number}"
        sent.append(lasting)
        if len(sent) == 1:
            return
        if len(sent) > order.retry + 1:
            self._market.violated("ordered-twice", f"{which} was ordered {len(sent)} times")
        was_under_way = self._market.scheduler.now_ns < order.called_off_ns + CALLED_OFF_NS and not order.is_stopped
        if order.called_off_ns and not was_under_way:
            self._market.violated("ordered-after-stop", which)
        if self._market.deployed.chain.reorganisations:
            return
        for earlier in sent[:-1]:
            ends = [self._steps.ended.get(one) for one in self._contracts(earlier)]
            if ends != [False]:
                detail = f"{which} is ordered again, the ends of the contracts before are {ends}"
                self._market.violated("ordered-before-refund", detail)

    def versions(self, demand: str) -> set[str]:
        """The hashes of all versions of a demand that was sent."""
        lasting = self._lasting.get(demand)
        return {one for one, shared in self._lasting.items() if shared == lasting is not None}

    def created(self, liability: str, demand: str) -> None:
        """A demand became a contract."""
        robot = self.robots.get(demand)
        if robot is not None and (promisor := self._promisor(liability)) != robot.lower():
            self._market.violated("other-robot", f"{liability} is with {promisor}, and was for {robot}")
        maker = person, number = self._steps.demands[demand]
        sent = self._sent[maker]
        earlier = sent[: sent.index(self._lasting[demand])]
        if earlier and person.orders[number].called_off_ns and not self._market.whims.has_faults:
            self._too_late.add(liability)
        if not earlier or self._market.deployed.chain.reorganisations:
            return
        failed = {self._promisor(one) for lasting in earlier for one in self._contracts(lasting)}
        if (promisor := self._promisor(liability)) in failed:
            self._market.violated("same-robot-again", f"{liability} is with {promisor}, which has failed")

    def stopped(self, liability: str, by: str) -> None:
        """The robot of a liability has said that its job is stopped, or handed back."""
        self._stopped.setdefault(liability, by)
        if self._steps.ended.get(liability):
            self._violated_stop(liability, by)

    def ended(self, liability: str, *, success: bool) -> None:
        """A contract has ended."""
        if success and (by := self._stopped.get(liability)) is not None:
            self._violated_stop(liability, by)
        if success and liability in self._too_late - self._asked_to_stop:
            self._market.violated("called-off-job-paid", f"{liability} was made after its person had stopped the job")

    def at_end(self) -> None:
        """Of no job two contracts were paid, or were made of one demand; and none was paid that its robot stopped."""
        made: dict[tuple[PersonRole, int], list[str]] = {}
        for liability, demand in self._steps.liabilities.items():
            if (maker := self._steps.demands.get(demand)) is not None:
                made.setdefault(maker, []).append(liability)
        for (person, number), liabilities in made.items():
            shared = {self._lasting[self._steps.liabilities[one]] for one in liabilities}
            paid = [one for one in liabilities if self._steps.ended.get(one)]
            if len(shared) < len(liabilities):
                self._market.violated("ordered-twice", f"{person.name}'s job {number}: {liabilities}")
            if len(paid) > 1 and not self._market.deployed.chain.reorganisations:
                self._market.violated("job-paid-twice", f"{person.name}'s job {number}: {paid}")
        for robot in self._market.robots:
            for path in sorted(robot.folder.rglob("ledger.sqlite")):
                with closing(sqlite3.connect(path)) as database:
                    # A robot that was killed for good before its first start has a file without tables.
                    if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'stops'").fetchone():
                        continue
                    for (liability,) in database.execute("SELECT liability FROM stops").fetchall():
                        if self._steps.ended.get(liability):
                            self._violated_stop(liability, robot.name)

    def _violated_stop(self, liability: str, by: str) -> None:
        self._market.violated("stopped-job-paid", f"{liability}, stopped by {by}")

    def _contracts(self, lasting: str) -> list[str]:
        """The liabilities of the versions of a demand."""
        return [one for one, demand in self._steps.liabilities.items() if self._lasting.get(demand) == lasting]

    def _promisor(self, liability: str) -> str:
        return "0x" + self._call(liability, PROMISOR)[-20:].hex()

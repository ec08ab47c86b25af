"""Those who take part in a simulated market: processes that are started again after each crash."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mesh.agent.agent import CHOICES, Agent
from mesh.agent.contracts import LiabilityReverted
from mesh.agent.handlers import JobFailed
from mesh.agent.jobs import STOPPED
from mesh.agent.ledger import Phase
from mesh.agent.orders import OrderClosed, OrderExpired, OrderState
from mesh.chain import XRT, Chain, ContractNames
from mesh.errors import AiraError
from mesh.market.provider import Provider, ProviderOptions, provider_file
from mesh.network import Endpoints, Network
from mesh.settings import Settings
from mesh.validator.validator import Validator
from schemas import String, decode, message_hash
from tests.simulation import loop
from tests.simulation.chain import NodeFaults, SimulatedNode
from tests.simulation.deployment import ENDPOINT, LIFETIMES, MODEL, SHORT_LIFETIMES, STAKE, TIMING
from tests.simulation.scheduler import Process

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from mesh.agent.agent import DemandTerms
    from mesh.agent.contracts import Contract, Outcome, Progress
    from mesh.market import Match
    from schemas import Demand
    from tests.simulation.market import Market


CENT: Final = XRT // 100
BROKEN_OFF_WITHIN: Final = (1.0, 8.0)
"""Seconds within which jobs are stopped and handed back: before they begin, while they are done, and after."""
START_WITHIN: Final = (None, None, 1.0, 15.0)
MOST_RETRIES: Final = 3
STOPPED_WITHIN: Final = (4.0, 4.0, 60.0)
"""The same for people: soon after the contract, or also what follows it."""
TRACED: Final = ("late", "again", "given-up", "contract")
"""What people hear of further attempts."""
REFUND_CHECK: Final = 20.0
"""Seconds after which people look again whether they can take a cost back."""


@dataclass
class Ordered:
    """What a person wanted, and what they were told."""

    person: str
    number: int
    cost: int
    order: str = ""
    contract: str = ""
    posted: int = 0
    """The block at which the order was posted."""
    deadline: int = 0
    retry: int = 0
    """How often it is ordered again when it fails, at most."""
    called_off_ns: int = 0
    """When the person stopped it; 0: not, or in an earlier start of its program."""
    is_stopped: bool = False
    """Whether the robot has said then that it stops."""
    used_up: bool = False
    """Whether the withdrawal of the order is on the chain."""
    told: str = ""
    """The last thing: ordered, accepted, withdrawn, expired, paid, refunded, reverted, or an error's code."""
    told_ns: int = 0
    told_block: int = 0
    """When, and at which block."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more is expected."""
        return self.told not in ("", "ordered", "accepted")

    @property
    def is_dead(self) -> bool:
        """Whether the person believes that it can't become a contract any more."""
        return self.told in ("expired", "nothing-found") or (self.told == "withdrawn" and self.used_up)


class NothingFound(AiraError, code="nothing-found"):
    """A person's order of before a crash is not open, and they know no contract."""


class Role:
    """A participant: a process that is started again after each crash, with what its disk kept."""

    def __init__(self, market: Market, name: str) -> None:
        self.market = market
        self.name = name
        self.account = market.deployed.accounts[name]
        self.folder = market.folder / name
        self.process: Process | None = None
        self.starts = 0
        self.errors: list[BaseException] = []
        self.node_faults = NodeFaults(draw=market.draw)
        """Of the first node that the process asks."""
        self.all_node_faults = [
            self.node_faults,
            *(NodeFaults(draw=market.draw) for _ in range(market.plan.nodes - 1)),
        ]
        self.wall_offset_ns = 0
        self.has_left = False
        """Whether it never comes back."""

    async def main(self) -> None:
        """What the process does."""
        raise NotImplementedError

    def start(self) -> None:
        """Start the process."""
        market = self.market
        self.starts += 1
        process = self.process = Process(market.scheduler, f"{self.name}#{self.starts}")
        process.wall_offset_ns = self.wall_offset_ns
        process.on_crash = lambda: self._crashed(process)
        process.on_busy = lambda: market.violated("busy", f"{process.name} polls without a pause")
        self.folder.mkdir(parents=True, exist_ok=True)
        if not self.market.is_calm:
            market.plan_crash(self, process)
        loop.start(market.scheduler, process, self.main, lambda error: self._ended(process, error))

    def crash(self) -> None:
        """Kill the process."""
        if self.process is not None and not self.process.is_dead:
            self.market.scheduler.crash(self.process)

    def _crashed(self, process: Process) -> None:
        """The process was killed, perhaps together with its machine. It is started again after a while."""
        market, chance = self.market, self.market.draw.random
        market.router.lose(process)
        is_power_failure = chance.random() < 0.5
        kind = "power-failure" if is_power_failure else "kill"
        market.draw.counts[kind] += 1
        market.trace(self.name, kind, steps=process.steps, commits=process.commits)
        market.scheduler.call_later(chance.uniform(0.2, 20), self._restart_from_disk, is_power_failure)

    def _ended(self, process: Process, error: BaseException | None) -> None:
        """The process ended by itself, which only an error makes it do."""
        market = self.market
        market.router.lose(process)
        if error is not None:
            self.errors.append(error)
            market.ended(self, error)
        market.scheduler.call_later(market.scheduler.random.uniform(0.2, 20), self._restart_from_disk, False)

    def _restart_from_disk(self, is_power_failure: bool) -> None:
        if not self.market.is_over and not self.has_left:
            self.market.disk.crash(self.folder, power=is_power_failure)
            self.start()

    def chain(self) -> Chain:
        """The chain, as this process reaches it."""
        nodes = [
            SimulatedNode(self.market.deployed.chain, faults, number)
            for number, faults in enumerate(self.all_node_faults)
        ]
        return Chain(
            nodes,
            account=self.account,
            contracts=ContractNames(
                generation=self.market.plan.generation, ens=self.market.deployed.market.deployment.ens
            ),
            timing=TIMING,
            transactions=self.folder / "transactions",
        )

    @property
    def lighthouse(self) -> str:
        """The name of the market's lighthouse in its generation."""
        name = self.market.deployed.market.deployment.lighthouse_name
        return name.replace(".3.", f".{self.market.plan.generation}.")

    def settings(self) -> Settings:
        """Its settings."""
        deployment = self.market.deployed.market.deployment
        return Settings(
            connect=(ENDPOINT,),
            connect_timeout=-1,
            data_dir=str(self.folder),
            generation=self.market.plan.generation,
            lighthouse_contract=self.lighthouse,
            ens_contract=deployment.ens,
            poll_interval=TIMING.poll_interval,
            fetch_timeout=60.0,
        )


class ProviderRole(Role):
    """A provider."""

    provider: Provider | None = None

    async def main(self) -> None:
        """Match and settle."""
        async with Network(Endpoints(connect=(ENDPOINT,), timeout=-1)) as network, self.chain() as chain:
            await chain.lighthouses.become_provider(self.lighthouse, STAKE)
            store = await provider_file(self.settings(), chain, self.account.address, self.lighthouse)
            options = ProviderOptions(free_contracts=1_000_000, store=store)
            async with Provider(
                network.session, chain, self.lighthouse, options, matched=self._matched
            ) as self.provider:
                await self.provider.run()

    def _matched(self, match: Match) -> None:
        self.market.matched(self.name, match)


class RobotRole(Role):
    """A robot with a lamp."""

    agent: Agent | None = None

    def start(self) -> None:
        """Start the process."""
        self._tasks: set[asyncio.Future[None]] = set()
        super().start()

    def price(self, asker: str) -> int:
        """What it wants for the job that a person wants next: some robots want more than the person gives."""
        order = next(one for one in self.market.people if one.account.address == asker).orders[-1]
        number = order.number * 7 + self.market.robots.index(self) * 3
        return order.cost - number % 3 * CENT if number % 10 else order.cost + CENT

    async def main(self) -> None:
        """Offer, and work."""
        market = self.market
        async with self.chain() as chain:
            agent = self.agent = Agent(MODEL, settings=self.settings(), account=self.account, chain=chain)

            @agent.on("*")
            async def play(job: Any, message: Any) -> None:
                if market.fails(job.liability.address):
                    raise JobFailed("the lamp is broken")
                job.publish("/led", String("on"))
                await asyncio.sleep(0.05)

            @agent.on_demand
            async def offer(demand: Any) -> None:
                await agent.offer(demand)

            @agent.on_quote
            async def quote(request: Any) -> int:
                return self.price(request.asker)

            @agent.on_liability
            async def phase(phase: Any, liability: Any) -> None:
                market.trace(self.name, f"job-{phase.value}", liability=liability.address)
                if phase is Phase.INCOMING:
                    self._break_off(agent, liability.address)

            await agent.serve()

    def _break_off(self, agent: Agent, address: str) -> None:
        """Perhaps hand a new job back soon, or let the robot's owner stop it."""
        whims, draw = self.market.whims, self.market.draw
        if draw("job-handed-back", whims.hand_back):
            self._tasks.add(asyncio.ensure_future(self._hand_back(agent, address)))
        if draw("robot-stopped", whims.owner_stop):
            self._tasks.add(asyncio.ensure_future(self._stop(agent, address)))

    async def _wait(self) -> None:
        chance = self.market.draw.random
        await asyncio.sleep(chance.uniform(0, chance.choice(BROKEN_OFF_WITHIN)))

    async def _hand_back(self, agent: Agent, address: str) -> None:
        await self._wait()
        with suppress(AiraError):  # it has ended
            await agent.hand_back(address, "lamp-broken", "the lamp is broken")
            self.market.trace(self.name, "handed-back", liability=address)
            self.market.steps.attempts.stopped(address, self.name)

    async def _stop(self, agent: Agent, address: str) -> None:
        await self._wait()
        with suppress(AiraError):
            await (await agent.contract(address)).stop("its owner needs the lamp")
            self.market.trace(self.name, "stopped", liability=address)
            self.market.steps.attempts.stopped(address, f"the owner of {self.name}")


class JurorRole(Role):
    """One of the accounts that judge for the market's validator."""

    async def main(self) -> None:
        """Judge results."""
        validator = self.market.deployed.validator
        async with self.chain() as chain:
            await Validator(validator, settings=self.settings(), account=self.account, chain=chain).serve()


class PersonRole(Role):
    """A person who wants some jobs done: one after the other, or some at a time."""

    agent: Agent | None = None

    def __init__(self, market: Market, name: str, jobs: int) -> None:
        super().__init__(market, name)
        self.wanted = jobs
        self.orders: list[Ordered] = []
        self.listed: set[str] = set()
        """The orders (hashes) that the agent of this start has listed."""
        self.has_begun = False
        self._revoking: asyncio.Future[None] | None = None

    def start(self) -> None:
        """Start the process."""
        self.listed, self.has_begun, self._revoking = set(), False, None
        super().start()

    @property
    def agent_is_open(self) -> bool:
        """Whether the person can ask the agent for its orders."""
        return self.has_begun and self.process is not None and not self.process.is_dead

    @property
    def is_done(self) -> bool:
        """Whether the person wants nothing more."""
        return len(self.orders) >= self.wanted and all(order.is_over for order in reversed(self.orders))

    def number_of(self, demand: Demand) -> int:
        """Which of this person's orders a demand is. The cost of each says so where several are open at a time."""
        return demand.cost % CENT if self.market.plan.at_once > 1 else len(self.orders) - 1

    async def main(self) -> None:
        """Take up what was ordered before a crash, then order the jobs that are left."""
        async with self.chain() as chain:
            self.agent = agent = Agent(MODEL, settings=self.settings(), account=self.account, chain=chain)
            async with agent:
                self.has_begun = True
                taking_back = asyncio.ensure_future(self._take_back(agent))
                try:
                    await self._live(agent)
                finally:
                    self.has_begun = False
                    taking_back.cancel()

    async def _live(self, agent: Agent) -> None:
        """Finish what was ordered, and order the jobs that are left, each of some tasks one after the other."""
        begun = [order for order in self.orders if not order.is_over]
        missing = self.market.plan.at_once - len(begun)
        first, *others = (self._order_jobs(agent, order) for order in (*begun, *(missing * [None])))
        if others:
            await asyncio.gather(first, *others)
        else:
            await first

    async def _order_jobs(self, agent: Agent, begun: Ordered | None) -> None:
        chance, plan = self.market.scheduler.random, self.market.plan
        if begun is not None:
            await self._finish(agent, begun, self._take_up(agent, begun))
        while len(self.orders) < self.wanted:
            await asyncio.sleep(chance.uniform(0.1, plan.pause))
            number = len(self.orders)
            if number < self.wanted:  # another task may have ordered the last one
                units = chance.randint(1, 50)
                wanted = Ordered(self.name, number, units * CENT + number if plan.at_once > 1 else units * XRT)
                self.orders.append(wanted)
                await self._finish(agent, wanted, self._order(agent, wanted))
        await asyncio.Event().wait()

    async def _order(self, agent: Agent, wanted: Ordered) -> Contract:
        """Post an order, and wait for its contract; some are withdrawn."""
        chance, draw = self.market.scheduler.random, self.market.draw
        objective = self.market.objective(chance.randint(2, 12))
        lifetime = chance.choice(
            SHORT_LIFETIMES if draw("order-short-lived", self.market.whims.short_lived) else LIFETIMES
        )
        self.market.trace(self.name, "demands", number=wanted.number, cost=wanted.cost)
        terms = self._choose(wanted)
        terms |= {"cost": wanted.cost, "lifetime": lifetime}
        terms |= {"validator": self.market.deployed.validator, "validator_fee": 0}
        order = await agent.order(objective, **terms)
        wanted.order, wanted.told = order.hash, "ordered"
        wanted.posted, wanted.deadline = self.market.deployed.chain.evm.head, order.message.deadline
        if draw("allowance-revoked", self.market.whims.revoke) and (self._revoking is None or self._revoking.done()):
            self._revoking = asyncio.ensure_future(self._revoke(agent))
        if draw("order-withdrawn", self.market.whims.withdraw):
            await asyncio.sleep(chance.uniform(0.1, 20))
            on_chain = chance.random() < 0.5
            try:
                await (order.withdraw_on_chain() if on_chain else order.withdraw())
            except OrderClosed as error:
                if error.state != OrderState.MATCHED or not wanted.retry:
                    raise  # its agent does not order this job again, so the person may turn to the next one
            else:
                wanted.used_up = on_chain
                self.market.trace(self.name, "withdrew", order=order.hash[:12], on_chain=on_chain)
        return await order.contract()

    def _choose(self, wanted: Ordered) -> DemandTerms:
        """From whom a person orders, and what happens when the job fails. Several at a time have no quotes here."""
        chance, draw, market = self.market.scheduler.random, self.market.draw, self.market
        terms: DemandTerms = {}
        has_quotes = market.plan.at_once == 1
        if draw("order-paired", market.whims.pair):
            named = [robot.account.address for robot in market.robots]
            terms["robot"] = chance.choice([*named, *(2 * CHOICES if has_quotes else ())])
        if terms.get("robot", "") in ("", *CHOICES) and has_quotes and draw("order-retried", market.whims.retry):
            wanted.retry = terms["retry"] = chance.randint(1, MOST_RETRIES)
            terms["start_within"] = chance.choice(START_WITHIN)
        self.market.trace(self.name, "chooses", number=wanted.number, **terms)
        return terms

    async def _revoke(self, agent: Agent) -> None:
        """Take the factory's allowance away for a while: providers then reject orders, which are still valid."""
        chain, chance = agent.parts.chain, self.market.scheduler.random
        with suppress(AiraError):
            allowed = await chain.tokens.allowance(self.account.address, chain.factory)
            await chain.tokens.approve(chain.factory, 0)
            self.market.trace(self.name, "revoked", allowance=allowed)
            await asyncio.sleep(chance.uniform(1, 60))
            if self.market.plan.at_once > 1:  # the agent may have approved more for other orders
                allowed = max(allowed, await chain.tokens.allowance(self.account.address, chain.factory))
            await chain.retrying(lambda: chain.tokens.approve(chain.factory, allowed))

    async def _take_up(self, agent: Agent, wanted: Ordered) -> Contract:
        """What a person finds after a crash: the contract, the open order that the agent says it has, or nothing.

        Of a job that is ordered again, the open order or the contract may be of a further attempt, which is the last.
        """
        wanted.called_off_ns, wanted.is_stopped = 0, False
        if wanted.contract and not wanted.retry:
            return await agent.contract(wanted.contract)
        known = {order.order for order in self.orders if order is not wanted}
        for order in agent.orders(OrderState.OPEN, OrderState.WITHDRAWN):
            is_it = self.market.plan.at_once == 1 or order.message.cost == wanted.cost
            if order.kind == "demand" and order.hash not in known and is_it:
                if wanted.order != order.hash and wanted.retry:
                    wanted.posted = self.market.deployed.chain.evm.head
                wanted.order = order.hash
                return await order.contract()
        mine = {demand for demand, maker in self.market.steps.demands.items() if maker == (self, wanted.number)}
        for payload, address in await agent.parts.ledger.contracts("demand"):
            if message_hash(decode(payload)).hex() in mine:
                return await agent.contract(address)
        if wanted.contract:
            return await agent.contract(wanted.contract)
        raise NothingFound("no order of before the crash is open")

    async def _finish(self, agent: Agent, wanted: Ordered, contract_of: Coroutine[Any, Any, Contract]) -> None:
        """Wait for a contract and its end, and note what the person was told."""
        try:
            contract = await contract_of
            wanted.contract, wanted.told = contract.address, "accepted"
            self.market.trace(self.name, "accepted", liability=contract.address)
            outcome = await self._outcome(contract, wanted)
            wanted.contract, wanted.told = contract.address, "paid" if outcome.success else "refunded"
        except OrderExpired:
            wanted.told = "expired"
        except OrderClosed as error:
            wanted.told = error.state
        except LiabilityReverted:
            wanted.told = "reverted"
        except AiraError as error:
            wanted.told = error.code
        self.market.trace(self.name, wanted.told, number=wanted.number)
        self.market.steps.told(self, wanted.number)

    async def _outcome(self, contract: Contract, wanted: Ordered) -> Outcome:
        """Wait for the end of a contract, and of those that follow it; some are stopped."""
        said: list[Progress] = []

        def hear(progress: Progress) -> None:
            if progress.kind in TRACED:
                said.append(progress)
                self.market.trace(self.name, progress.kind, code=progress.code, detail=progress.detail)
            if progress.kind == "contract":
                wanted.contract = progress.detail
            if wanted.is_stopped and progress.kind in ("again", "given-up"):
                self.market.violated("ordered-after-stop", f"{self.name}'s job {wanted.number}: {progress}")

        stopping = None
        if self.market.draw("job-stopped", self.market.whims.stop):
            stopping = asyncio.ensure_future(self._stop(contract, wanted))
        try:
            outcome = await (contract.outcome(on_progress=hear) if contract.number else contract.outcome())
        finally:
            if stopping is not None:
                stopping.cancel()
        self._check_attempts(wanted, outcome, {progress.kind for progress in said} if contract.number else None)
        return outcome

    def _check_attempts(self, wanted: Ordered, outcome: Outcome, said: set[str] | None) -> None:
        """The outcome of a job names each attempt; it has no fewer than the person wants, unless they are told why."""
        robots = [one.robot for one in (*outcome.earlier, outcome)]
        if len(set(robots)) < len(robots) or any(one.success for one in outcome.earlier):
            self.market.violated("attempts-untrue", f"{self.name}'s job {wanted.number}: {outcome}")
        is_given_up = said is None or "given-up" in said or len(robots) > wanted.retry
        if not (outcome.success or is_given_up or wanted.called_off_ns or outcome.code == STOPPED):
            self.market.violated("not-ordered-again", f"{self.name}'s job {wanted.number}: {outcome}")

    async def _stop(self, contract: Contract, wanted: Ordered) -> None:
        chance = self.market.scheduler.random
        await asyncio.sleep(chance.uniform(0, chance.choice(STOPPED_WITHIN)))
        wanted.called_off_ns = self.market.scheduler.now_ns
        try:
            await contract.stop("changed my mind")
        except AiraError as error:
            self.market.trace(self.name, "not-stopped", liability=contract.address, code=error.code)
        else:
            wanted.is_stopped = True
            self.market.trace(self.name, "stopped", liability=contract.address)
            self.market.steps.attempts.stopped(contract.address, self.name)

    async def _take_back(self, agent: Agent) -> None:
        """Take back the cost of each contract that nobody ended in time, also of orders that were withdrawn."""
        liabilities = agent.parts.chain.liabilities
        while True:
            await asyncio.sleep(REFUND_CHECK)
            with suppress(AiraError):
                if self.market.plan.at_once > 1:  # more than the ledger lists
                    known = self.market.steps.contracts_of(self)
                else:
                    known = [address for _, address in await agent.parts.ledger.contracts("demand")]
                for address in known:
                    if self.market.steps.is_ended(address):
                        continue
                    if (await liabilities.refund_state(address)).is_refundable:
                        await liabilities.refund(address)
                        self.market.trace(self.name, "took-back", liability=address)

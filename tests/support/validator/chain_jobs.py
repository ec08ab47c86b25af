"""Whole jobs on a chain in which a robot hands in a tampered recording: what the validator signs, and what is paid."""

from __future__ import annotations

import asyncio
import dataclasses
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from mesh.base.background import Background
from mesh.chain import Account, DeploymentPlan
from mesh.testing import MarketChain
from schemas import Offer
from schemas.keys import ResultKey
from tests.support.market import Place
from tests.support.routers import client_config
from tests.support.validator.courts import FEE, PRICE, Court
from tests.support.validator.lamps import (
    LEVELS,
    MODEL,
    OWN,
    ROBOT,
    SHIPPED,
    THIEF,
    LampRobot,
    follows_levels,
    order,
    signed_by,
)
from tests.support.validator.tampered_claims import tampered, tamperings
from tests.support.validator.tampering import Others

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path
    from typing import Self

    from mesh.agent.agent import Agent
    from mesh.agent.contracts import Contract
    from schemas import Demand, Liability, Verified
    from tests.support.validator.lamps import FinishedJob
    from tests.support.validator.tampering import Tampering

IMPOSSIBLE: Final = frozenset({"the objective is exchanged for an easier one", "the objective is no recording"})
"""On a chain a contract names its objective by its hash."""
UNHEARD: Final = frozenset(
    {
        "somebody else signed the Result",
        "the Result is of another liability",
        "the Result names another recording",
        "the recording was exchanged after it was signed",
        "the fetched file has another CID",
        "the message is a Demand",
        "the message is not readable",
        "the signature is cut off",
    }
)
"""What no validator takes for the promisor's Result, or whose recording nobody can serve: it is never judged."""
AT_A_TIME: Final = 6
AGAIN: Final = 0.4
"""Seconds after which a robot hands in its Result again."""
REFUND_DELAY: Final = 1_000
"""Blocks; the jobs mine fewer."""
SECONDS: Final = 1_200.0
"""How long all may take."""
HONEST: Final = 2
"""Jobs that the robot does honestly before it tampers."""
THIEF_PRICE: Final = PRICE + 1
"""What the thief's job costs, so that only the thief offers."""


class HandedIn(NamedTuple):
    """How the job of a tampered recording ended."""

    tampering: Tampering
    liability: Liability
    codes: Collection[str]
    """The failures in the report of the juror, `policy/code`; empty if it has not judged."""


class Tamperers:
    """A court with a person, a robot that tampers and a thief. `async with Tamperers(court, folder) as tamperers`."""

    def __init__(self, court: Court, folder: Path) -> None:
        self._court = court
        self._folder = folder
        self._stack = AsyncExitStack()
        self._turns = asyncio.Semaphore(AT_A_TIME)
        self._ordering = asyncio.Lock()  # orders of generation 5 that are the same have the same hash until one is used

    async def __aenter__(self) -> Self:
        enter, court = self._stack.enter_async_context, self._court
        self._objective = order(self._folder / "objective.mcap")
        self._session = self._stack.enter_context(zenoh.open(client_config(court.place.endpoint)))
        self._jury = await court.jury(0)
        validator = await court.validator(0, self._jury, policies=SHIPPED)
        validator.check(OWN.name, description=OWN.description)(follows_levels)
        await enter(court.place.provider(seconds=SECONDS))
        await enter(validator)
        self.person = await enter(await court.agent("person", MODEL.cid))
        await asyncio.to_thread(self.person.parts.store.put_bytes, MODEL.encode())
        self._robot = await enter(await self._liar("tamperer", b"\x01" * 32, PRICE))
        self._thief = await enter(await self._liar("thief", b"\x02" * 32, THIEF_PRICE))
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    async def honest(self) -> Others:
        """Honest jobs, which must be paid; `HONEST` of them to the robot."""
        easier = order(self._folder / "easier.mcap", LEVELS[:8])
        return Others(
            await self._paid("another", self._objective, self._robot),
            await self._paid("thief's", self._objective, self._thief),
            await self._paid("easy", easier, self._robot),
        )

    async def hand_in(self, found: Collection[Tampering]) -> list[HandedIn]:
        """Do a job for each, hand in what was tampered with until the contracts have ended, and refund those left."""
        async with Background() as tasks:
            async with asyncio.TaskGroup() as group:
                jobs = [group.create_task(self._hand_in(one, f"job-{n}", tasks)) for n, one in enumerate(found)]
            return [await self._end(one, job.result()) for one, job in zip(found, jobs, strict=True)]

    async def earned(self) -> int:
        """The balance of the robot, wn."""
        return await self.person.parts.chain.tokens.balance(ROBOT.address)

    async def _liar(self, name: str, key: bytes, price: int) -> Agent:
        """A robot that offers for demands of a price, and leaves the work to others."""
        agent = await self._court.agent(name, MODEL.cid, account=Account(key))
        agent.settings = dataclasses.replace(agent.settings, enable_executor=False)

        @agent.on_demand
        async def offer(demand: Verified[Demand]) -> None:
            if demand.message.cost == price:
                trader = agent.runtime.trader
                await trader.post(Offer, trader.writer.terms_of(demand.message), lighthouse_fee=0)

        return agent

    async def _job(self, name: str, objective: Path, robot: Agent) -> tuple[Contract, FinishedJob]:
        """A contract, and the honest job for it."""
        signer, cost = (ROBOT, PRICE) if robot is self._robot else (THIEF, THIEF_PRICE)
        async with self._ordering:
            contract = await self.person.demand(objective, cost=cost, validator=self._jury, validator_fee=FEE)
        assert contract.liability.promisor == signer.address
        lamp = LampRobot(self._session, self._folder / name, robot=signer)
        return contract, await lamp.work(name, objective, liability=contract.liability)

    async def _paid(self, name: str, objective: Path, robot: Agent) -> FinishedJob:
        contract, job = await self._job(name, objective, robot)
        await robot.add(job.recording)
        async with Background() as tasks:
            tasks.start(self._send(robot, job.message), name)
            outcome = await contract.outcome()
        assert outcome.success, outcome
        return job

    async def _hand_in(self, one: Tampering, name: str, tasks: Background) -> Contract:
        """Hand in a tampered recording, again and again, until it is judged or as long as it is not heard."""
        async with self._turns:
            contract, job = await self._job(name, self._objective, self._robot)
            forged = tampered(job, one, self._folder / name / "tampered")
            recording, message = await self._robot.add(forged.recording), forged.message
            if forged.recording_cid or not forged.claimed:  # a Result says both on a chain
                recording = forged.recording_cid or recording
                message = signed_by(ROBOT, contract.address, recording, success=forged.claimed)
            tasks.start(self._send(self._robot, message), name)
            if one.kind not in UNHEARD:
                await contract.outcome()
        return contract

    async def _send(self, robot: Agent, message: bytes) -> None:
        while True:
            robot.channel.put(str(ResultKey(robot.channel.lighthouse)), message)
            await asyncio.sleep(AGAIN)

    async def _end(self, one: Tampering, contract: Contract) -> HandedIn:
        """How a job ended; one that nobody judged is refunded after the delay."""
        liabilities, node = self.person.parts.chain.liabilities, self._court.place.node
        liability = await liabilities.get(contract.address)
        if not liability.is_finalized:
            until = await liabilities.refundable_from(contract.address)
            await node.mine(max(until - await self.person.parts.chain.block_number(), 1))
            await liabilities.refund(contract.address)
            liability = await liabilities.get(contract.address)
        failures = (failure for report in await contract.reports() for failure in report.failures)
        return HandedIn(one, liability, {f"{failure.policy}/{failure.code}" for failure in failures})


async def hand_in_tampered(endpoint: str, folder: Path, kinds: Collection[str] = ()) -> list[HandedIn]:
    """Hand in recordings that were tampered with in these ways, or in all, in a market of their own."""
    plan = DeploymentPlan(timeout_blocks=100, refund_delay=REFUND_DELAY)
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        chain = await enter(MarketChain(plan))
        court = await enter(Court(await enter(Place(chain, endpoint, folder)), 5))
        tamperers = await enter(Tamperers(court, folder))
        others = await tamperers.honest()
        ways = [one for one in tamperings(others) if one.kind not in IMPOSSIBLE]
        jobs = await tamperers.hand_in([one for one in ways if not kinds or one.kind in kinds])
        paid = [job.tampering.kind for job in jobs if job.liability.is_success]
        assert await tamperers.earned() == PRICE * (HONEST + len(paid)), paid
        return jobs

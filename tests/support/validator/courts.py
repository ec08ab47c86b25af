"""Jurors at work in the market of a test, and robots and jobs for them to judge."""

from __future__ import annotations

import dataclasses
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, Literal

from mesh.agent.agent import Agent
from mesh.chain import Account
from mesh.testing._market import RESEND
from mesh.validator.validator import Validator
from mesh.watching.market import query_all
from schemas import Result
from schemas.keys import ValidatorKey, report_selector
from schemas.verdicts import ValidatorAnnouncement, ValidatorReport
from tests.support.market import MODEL, Place, offering_unseen
from tests.support.objectives import objective
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent.contracts import Contract
    from mesh.agent.handlers import Job
    from mesh.chain import Chain
    from schemas import Liability

PRICE = 7
FEE = 3


class Court:
    """The market of a test in one generation, with any number of jurors. Enter with `async with`."""

    def __init__(self, place: Place, generation: Literal[3, 5] = 3) -> None:
        self.place = place
        self.generation = generation
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Court:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    def account(self, number: int = 0) -> Account:
        """The account of a juror: one of the chain's own, with ETH."""
        return Account(self.place.node.funded_keys[4 + number])

    async def chain(self, account: Account) -> Chain:
        return await self._stack.enter_async_context(self.place.chain_of(account, self.generation))

    async def jury(self, *numbers: int, quorum: int = 1) -> str:
        """The address of a validator contract with these jurors."""
        keeper = await self.chain(self.place.market.accounts["person"])
        made = await keeper.validators.deploy([self.account(number).address for number in numbers], quorum)
        return made.address

    async def validator(self, number: int = 0, contract: str = "", **options: Any) -> Validator:
        """A juror, not yet running; always with the same ledger."""
        account = self.account(number)
        settings = self.place.settings(f"juror-{number}", validator_contract=contract, generation=self.generation)
        chain = await self.chain(account)
        return Validator(settings=settings, account=account, chain=chain, resend=RESEND, **({"fee": FEE} | options))

    async def agent(self, role: str, model: str = MODEL, *, account: Account | None = None) -> Agent:
        """An agent of the person or the robot, or with an account of its own, that trades in this generation."""
        account = account or self.place.market.accounts[role]
        settings = dataclasses.replace(self.place.settings(role), generation=self.generation)
        chain = await self.chain(account)
        return Agent(model, settings=settings, account=account, chain=chain, resend=RESEND)

    async def robot(self) -> Agent:
        """A robot that offers for every demand, and reports each message that it did."""
        robot = offering_unseen(await self.agent("robot"))

        @robot.on("*")
        async def work(job: Job, message: Any) -> None:
            job.publish("/done", "done")

        return robot

    @asynccontextmanager
    async def at_work(self, *members: Agent | Validator) -> AsyncIterator[Agent]:
        """The provider and these at work; gives the person."""
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(self.place.provider())
            for member in members:
                await stack.enter_async_context(member)
            yield await stack.enter_async_context(await self.agent("person"))

    async def demand(self, person: Agent, validator: str, **terms: Any) -> Contract:
        """A job for the robot that names the validator."""
        job = self.place.save(objective(("/go", "there"), ("/go", "back")))
        options: dict[str, Any] = {"cost": PRICE, "validator_fee": FEE} | terms
        return await person.demand(job, validator=validator, **options)


async def liar(court: Court, *, account: Account | None = None) -> Agent:
    """A robot that offers for every demand and then does nothing."""
    robot = await court.agent("robot", account=account)
    robot.settings = dataclasses.replace(robot.settings, enable_executor=False)
    return offering_unseen(robot)


async def claim(robot: Agent, contract: Contract, recording: str, *, success: bool = True) -> None:
    """Say as the robot that a recording shows that the job was done, until the contract has ended."""
    result = Result(liability=contract.address, result=recording, success=success)
    await robot.parts.outbox.post(robot.parts.signer.sign(result))


async def asked(agent: Agent, selector: str) -> list[bytes]:
    """What others reply to a query. There must be somebody who may."""
    await until_answered(agent.network.session, selector.partition("?")[0])
    replies = await query_all(agent.network.session, [selector], timeout=30.0)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


async def reports_on(agent: Agent, contract: Contract) -> list[ValidatorReport]:
    """The reports that validators have on a contract of the agent's."""
    selector = report_selector(agent.channel.lighthouse, agent.address, contract.address)
    return [ValidatorReport.decode(payload) for payload in await asked(agent, selector)]


async def announcements_of(agent: Agent, validator: str, *, jurors: int = 1) -> list[ValidatorAnnouncement]:
    """What the jurors of a validator announce, once so many do.

    They hear Results then: they subscribe before.
    """
    selector = str(ValidatorKey(agent.channel.lighthouse, validator))

    async def announced() -> list[bytes]:
        payloads = await asked(agent, selector)
        return payloads if len(payloads) >= jurors else []

    payloads = await until_found(announced, what=f"{jurors} announcements")
    return [ValidatorAnnouncement.decode(payload) for payload in payloads]


async def open_cases(validator: Validator) -> dict[str, Liability]:
    """The cases of a validator that have not ended, by address: perhaps also some that earlier tests left open."""
    return {one.liability.address: one.liability for one in await validator.runtime.parts.ledger.unended()}


async def until_ended(validator: Validator, contract: Contract) -> None:
    """Return when a validator has seen the end of its case on the chain."""

    async def has_ended() -> bool:
        return contract.address not in await open_cases(validator)

    await until_found(has_ended, what="the end of the validator's case")

"""Jurors at work in the market of a test, and robots and jobs for them to judge."""

from __future__ import annotations

import dataclasses
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from mesh.agent import Agent, Job, Phase
from mesh.chain import Account, Chain
from mesh.validator.validator import Validator
from schemas import ReportKey, Result, encode
from schemas.verdicts import ValidatorReport
from tests.support.market import MODEL, QUICK, QUICK_RESEND, Place, in_phase, offering_unseen
from tests.support.objectives import objective

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.agent import Contract

PRICE = 7
FEE = 3


class Court:
    """The market of a test in one generation, with any number of jurors. Enter with `async with`."""

    def __init__(self, place: Place, generation: int = 3) -> None:
        self.place = place
        self.generation = generation
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Court:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    def account(self, number: int = 0) -> Account:
        """The account of a juror: one of the chain's own, with ETH."""
        return Account.from_key(self.place.node.funded_keys[4 + number])

    async def chain(self, account: Account) -> Chain:
        chain = Chain(
            self.place.node.provider,
            account=account,
            ens=self.place.market.deployment.ens,
            generation=self.generation,
            timing=QUICK,
        )
        return await self._stack.enter_async_context(chain)

    async def validator(self, number: int = 0, contract: str = "", **options: Any) -> Validator:
        """A juror, not yet running; always with the same ledger."""
        account = self.account(number)
        settings = self.place.settings(f"juror-{number}", validator_contract=contract, generation=self.generation)
        chain = await self.chain(account)
        return Validator(
            settings=settings, account=account, chain=chain, resend=QUICK_RESEND, **({"fee": FEE} | options)
        )

    async def agent(self, role: str) -> Agent:
        """An agent of the person or the robot that trades in this generation."""
        account = self.place.market.accounts[role]
        settings = dataclasses.replace(self.place.settings(role), generation=self.generation)
        chain = await self.chain(account)
        return Agent(MODEL, settings=settings, account=account, chain=chain, resend=QUICK_RESEND)

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


def claim_success(robot: Agent, contract: Contract, recording: str) -> Result:
    """Sign, as the robot, that a recording shows a success."""
    result = robot.parts.signer.sign(Result(liability=contract.address, result=recording, success=True))
    robot.parts.channel.publish(result)
    return result


__all__ = ["FEE", "PRICE", "Court", "Phase", "ReportKey", "ValidatorReport", "claim_success", "encode", "in_phase"]

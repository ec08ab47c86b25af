"""The page shows how a validator judged a job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas import ReportKey
from tests.mesh.agent.test_validated_contracts import judge, juror_of
from tests.mesh.agent.trades import job, working
from tests.support.jurors import MISSING, Juror
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from tests.support.market import Place


async def test_a_job_shows_its_verdict_and_why_it_was_refused(place: Place, serve: Any) -> None:
    robot = working(place.agent("robot"))
    async with juror_of(place) as juror, place.at_work(robot) as person, serve() as browser:
        contract = await person.demand(job(place), cost=5, validator=juror.signer.address)

        async def listed() -> Any:
            shown = await browser.get(f"liabilities/{contract.address}")
            return shown["timeline"]

        await until_found(listed, what="the contract")
        stranger = Juror(endpoint=place.endpoint, lighthouse=juror.lighthouse, signer=robot.parts.signer)
        stranger.validator = juror.validator  # an account that is present, but no juror
        person.channel.put(
            str(ReportKey(juror.lighthouse.lower(), person.address)),
            stranger.report(contract.liability, contract.liability.objective, success=True).encode(),
        )
        report = await judge(place, juror, robot, contract, success=False)

        async def refused() -> Any:
            shown = await browser.get(f"liabilities/{contract.address}")
            return shown if shown["liability"]["state"] == "failed" else None

        await until_found(refused, what="the refusal")
        shown = await refused()
        (judged,) = [step for step in shown["timeline"] if step["kind"] == "judged"]
        assert judged["agent"] == report.juror
        assert MISSING.detail in judged["detail"]
        assert (shown["reason"]["code"], MISSING.detail in shown["reason"]["text"]) == (MISSING.code, True)

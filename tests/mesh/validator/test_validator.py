"""Whole jobs with a validator: what it says is what is paid."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest

from mesh import ConfigurationError
from mesh.chain import XRT
from mesh.validator.runtime import Announcements
from tests.support.log_events import logged_facts
from tests.support.objectives import objective
from tests.support.raising import raises_with
from tests.support.validator.courts import FEE, PRICE, Court, announcements_of, claim, liar, reports_on, until_ended
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.validator.judging import Evidence
    from tests.support.market import Place


async def test_a_validated_job_is_paid_in_generation_3(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(title="A judge", policies=("acknowledged",)), await court.robot()
        async with court.at_work(validator, robot) as person:
            tokens = place.chains["person"].tokens
            before, earned = await place.balance("robot"), await tokens.balance(validator.address)
            contract = await court.demand(person, validator.address)
            assert (await contract.outcome()).success
            assert await place.balance("robot") == before + PRICE
            assert await tokens.balance(validator.address) == earned + FEE

            (report,) = await reports_on(person, contract)
            assert report.is_signed
            assert (report.juror, report.success, report.failures) == (validator.address, True, ())
            assert {finding.policy for finding in report.findings} == {"complete", "acknowledged"}
            assert await reports_on(robot, contract) == [report]

            (announcement,) = await announcements_of(person, validator.address)
            assert announcement.is_signed
            assert (announcement.title, announcement.fee, announcement.quorum) == ("A judge", FEE, 1)
            assert [policy.name for policy in announcement.policies] == ["complete", "acknowledged"]


async def test_an_announcement_is_signed_again_so_that_parties_believe_it(place: Place) -> None:
    async with Court(place) as court:
        validator = await court.validator()
        async with court.at_work(validator) as person:
            validator.runtime.announcements.refresh = 0
            (first,) = await announcements_of(person, validator.address)

            async def is_renewed() -> bool:
                (again,) = await announcements_of(person, validator.address)
                return again.is_signed and again.made_at > first.made_at

            await until_found(is_renewed, what="a later announcement")


async def test_announcements_stay_fresh(place: Place) -> None:
    """Parties ignore old ones: a validator that runs for days signs them again."""
    times = [1_000.0, 1_000.0 + Announcements.refresh - 1, 1_000.0 + Announcements.refresh, 500.0]
    async with Court(place) as court, await court.validator() as validator:
        announcements = Announcements(validator.runtime.parts, clock=lambda: times.pop(0))
        made = [announcements.announcement(validator.address) for _ in range(4)]
    assert [one.made_at for one in made] == [1_000, 1_000, 1_000 + Announcements.refresh, 500]
    assert all(one.is_signed for one in made)


async def test_undone_work_is_refunded_with_the_reason(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await liar(court)
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, validator.address)
            recording = await robot.add(place.save(objective(("/go", "nowhere")), "lie.mcap"))
            await claim(robot, contract, recording)
            outcome = await contract.outcome()
            assert (outcome.success, outcome.result) == (False, recording)
            (report,) = await reports_on(person, contract)
            assert report.claimed
            assert not report.success
            assert report.failures


async def test_a_claim_of_failure_needs_no_recording(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await liar(court)
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, validator.address)
            await claim(robot, contract, contract.liability.objective, success=False)
            assert not (await contract.outcome()).success
            (report,) = await reports_on(person, contract)
            assert [finding.code for finding in report.failures] == ["claimed"]


async def test_a_check_that_never_returns_delays_no_other_case(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    end, begun = threading.Event(), []
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()

        @validator.check("slow", description="It ends.", timeout=2)
        def slow(evidence: Evidence) -> bool:
            begun.append(evidence.liability.address)
            return len(begun) > 1 or end.wait()

        try:
            async with court.at_work(validator, robot) as person:
                unjudged = await court.demand(person, validator.address)
                await until(lambda: logged_facts(caplog, "case-not-judged"))
                contract = await court.demand(person, validator.address)
                assert (await contract.outcome()).success
                assert dict(validator.runtime.judge.verdicts) == {"none": 1, "success": 1}
                assert begun == [unjudged.address, contract.address]
                assert not (await place.chains["person"].liabilities.get(unjudged.address)).is_finalized
                assert await reports_on(person, unjudged) == []
        finally:
            end.set()


async def test_a_liability_that_pays_too_little_is_refunded(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(fee="1 XRT"), await court.robot()
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, validator.address, validator_fee=XRT - 1)
            assert not (await contract.outcome()).success
            (report,) = await reports_on(person, contract)
            assert [finding.code for finding in report.failures] == ["fee-too-low"]


async def test_a_validator_that_comes_late_judges_what_it_missed(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        await (await court.chain(court.account())).validators.introduce()
        async with court.at_work(robot) as person:
            contract = await court.demand(person, court.account().address)
            await asyncio.sleep(0.3)
            async with validator:
                assert (await contract.outcome()).success


async def test_a_reverted_verdict_is_sent_again(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        async with court.at_work(validator, robot) as person:
            before = await place.balance("robot")
            contract = await court.demand(person, validator.address)
            assert (await contract.outcome()).success
            await until_ended(validator, contract)
            await place.forget_blocks(1)
            reopened = {"liability": contract.address}
            await until(lambda: reopened in logged_facts(caplog, "case-reopened"), what="the reorganisation")
            await until_found(lambda: _is_paid(place, contract.address), what="a second payment")
            assert await place.balance("robot") == before + PRICE


async def _is_paid(place: Place, address: str) -> bool:
    return (await place.chains["person"].liabilities.get(address)).is_success


async def test_it_shows_its_status_and_metrics(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, validator.address)
            await contract.outcome()
            await until(lambda: validator.runtime.judge.verdicts["success"])
            names = {family.name for family in await validator.runtime.measure()}
            assert {"aira_validator_cases", "aira_verdicts_total", "aira_account_eth_wei"} <= names
            assert set(validator.runtime.status.health().values()) == {"alive"}


@pytest.mark.parametrize("name", ["nonsense", "rate:min=-1"])
def test_unknown_policies_are_refused(name: str) -> None:
    from mesh.settings import Settings
    from mesh.validator.validator import Validator

    with raises_with(ConfigurationError, code="invalid-policy"):
        Validator(settings=Settings(validator_policies=(name,)))

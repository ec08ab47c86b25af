"""Whole jobs of generation 5, which name a contract with jurors."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

from mesh import ChainError
from schemas import Result, verify
from tests.support.log_events import logged_facts
from tests.support.objectives import objective
from tests.support.raising import raises_with
from tests.support.validator.courts import PRICE, Court, announcements_of, claim, liar, reports_on, until_ended
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    import pytest

    from mesh import Evidence
    from tests.support.market import Place


async def test_a_validated_job_is_paid(place: Place) -> None:
    async with Court(place, 5) as court:
        jury = await court.jury(0)
        validator, robot = await court.validator(0, jury), await court.robot()
        async with court.at_work(validator, robot) as person:
            before = await place.balance("robot")
            contract = await court.demand(person, jury)
            assert (await contract.outcome()).success
            assert await place.balance("robot") == before + PRICE
            assert [report.success for report in await reports_on(person, contract)] == [True]
            (announcement,) = await announcements_of(person, jury)
            assert (announcement.validator, announcement.juror) == (jury, validator.address)
            assert (announcement.quorum, announcement.jurors) == (1, 1)


async def test_undone_work_is_refunded(place: Place) -> None:
    async with Court(place, 5) as court:
        jury = await court.jury(0)
        validator, robot = await court.validator(0, jury), await liar(court)
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, jury)
            recording = await robot.add(place.save(objective(("/go", "nowhere")), "lie.mcap"))
            await claim(robot, contract, recording)
            assert not (await contract.outcome()).success


async def test_two_jurors_of_one_contract_may_both_answer(place: Place) -> None:
    async with Court(place, 5) as court:
        jury = await court.jury(0, 1)
        members = await court.validator(0, jury), await court.validator(1, jury), await court.robot()
        async with court.at_work(*members) as person:
            assert {one.juror for one in await announcements_of(person, jury, jurors=2)} == {
                members[0].address,
                members[1].address,
            }
            for _ in range(2):
                assert (await (await court.demand(person, jury)).outcome()).success


async def test_a_quorum_must_agree(place: Place) -> None:
    """Two of three: the third is silent."""
    async with Court(place, 5) as court:
        jury = await court.jury(0, 1, 2, quorum=2)
        first, second, robot = await court.validator(0, jury), await court.validator(1, jury), await court.robot()
        async with court.at_work(first, robot) as person:
            contract = await court.demand(person, jury)
            await until_found(lambda: reports_on(person, contract), what="the first report")
            assert not (await place.chains["person"].liabilities.get(contract.address)).is_finalized
            async with second:
                assert (await contract.outcome()).success


async def test_what_others_sign_counts_for_nothing(place: Place) -> None:
    """The Results of a stranger: the juror waits for the promisor's."""
    async with Court(place, 5) as court:
        jury = await court.jury(0)
        validator, robot = await court.validator(0, jury), await liar(court)
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, jury)
            ledger = validator.runtime.parts.ledger
            await until_found(lambda: ledger.verdict(contract.address), what="the case")
            await announcements_of(person, jury)
            for success in (True, False):
                person.send(Result(liability=contract.address, result=contract.liability.model, success=success))
            await until(lambda: validator.runtime.results.received >= 2)
            await claim(robot, contract, contract.liability.objective, success=False)
            assert (await contract.outcome()).result == contract.liability.objective
            stored = await ledger.verdict(contract.address)
            assert stored is not None
            assert verify(stored.result).signer == robot.address


async def test_a_juror_that_signs_nonsense_is_outvoted(place: Place) -> None:
    """It says no, and then something else, about every job; two honest ones are the quorum."""
    async with Court(place, 5) as court:
        jury = await court.jury(0, 1, 2, quorum=2)
        first, second, robot = await court.validator(0, jury), await court.validator(1, jury), await court.robot()
        async with court.at_work(robot) as person:
            contract = await court.demand(person, jury)
            channel, signer = person.channel, court.account(2).signer
            for success, result in ((False, contract.liability.objective), (True, contract.liability.model)):
                nonsense = Result(liability=contract.address, result=result, success=success)
                channel.publish(signer.sign(nonsense))
            async with first, second:
                outcome = await contract.outcome()
            assert outcome.success
            assert outcome.result not in (contract.liability.objective, contract.liability.model)


async def test_a_reverted_end_is_repeated(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    async with Court(place, 5) as court:
        jury = await court.jury(0)
        validator, robot = await court.validator(0, jury), await court.robot()
        async with court.at_work(validator, robot) as person:
            before = await place.balance("robot")
            contract = await court.demand(person, jury)
            assert (await contract.outcome()).success
            await until_ended(validator, contract)
            await place.forget_blocks(1)
            reopened = {"liability": contract.address}
            await until(lambda: reopened in logged_facts(caplog, "case-reopened"), what="the reorganisation")
            liabilities = place.chains["person"].liabilities

            async def is_paid() -> bool:
                return (await liabilities.get(contract.address)).is_success

            await until_found(is_paid, what="a second payment")
            assert await place.balance("robot") == before + PRICE


async def test_a_validator_that_stops_while_it_judges_judges_again(place: Place) -> None:
    """As a crash would: what was judged is lost before it is signed."""
    async with Court(place, 5) as court:
        jury = await court.jury(0)
        judging, stay = threading.Event(), threading.Event()
        first, again, robot = await court.validator(0, jury), await court.validator(0, jury), await court.robot()

        @first.check("slow", description="Takes its time.")
        def slow(evidence: Evidence) -> bool:
            judging.set()
            stay.wait(30)
            return False

        async with court.at_work(robot) as person:
            contract = await court.demand(person, jury)
            async with first:
                await asyncio.to_thread(judging.wait, 30)
            async with again:
                assert (await contract.outcome()).success
            stay.set()


async def test_what_is_no_validator_of_this_account_is_refused_at_the_start(place: Place) -> None:
    async with Court(place, 5) as court:
        for contract, code in (
            (await court.jury(1), "not-a-juror"),
            (place.market.deployment.lighthouse, "not-a-validator"),
            (place.address("robot"), "not-a-validator"),
        ):
            with raises_with(ChainError, code=code):
                async with await court.validator(0, contract):
                    pass

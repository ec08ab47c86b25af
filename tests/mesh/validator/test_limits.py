"""What strangers can make a validator do is bounded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mesh.validator import runtime
from schemas import Result, cid_of_bytes
from tests.support.validator.courts import Court, announcements_of, liar, open_cases, until_ended
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    import pytest

    from tests.support.market import Place


async def test_results_for_other_liabilities_cost_nothing(place: Place) -> None:
    """A flood of a stranger's Results is dropped without a question to the chain, and a job is judged all the same."""
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        async with court.at_work(validator, robot) as person:
            stranger = court.account(3).signer
            await announcements_of(person, validator.address)
            flood = {"0x" + f"{number + 1:040x}" for number in range(300)}
            for address in flood:
                result = Result(liability=address, result=cid_of_bytes(address.encode()), success=True)
                person.channel.publish(stranger.sign(result))
            contract = await court.demand(person, validator.address)
            assert (await contract.outcome()).success
            await until(lambda: validator.runtime.results.received >= 300)
            await until_ended(validator, contract)
            assert flood.isdisjoint(await open_cases(validator))


async def test_one_promisor_s_open_cases_are_limited(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "CASE_LIMITS", runtime.CASE_LIMITS._replace(open_of_promisor=1))
    async with Court(place) as court:
        validator, robot = await court.validator(), await liar(court, account=court.account(4))
        async with court.at_work(validator, robot) as person:
            for _ in range(2):
                await court.demand(person, validator.address)
            head = await place.chains["person"].block_number()
            await until(lambda: validator.runtime.parts.chain_head.head >= head, what="both liabilities")
            assert validator.drops.totals()["cases"] >= 1
            assert [one.promisor for one in (await open_cases(validator)).values()].count(robot.address) == 1


async def test_files_that_are_too_large_fail_the_job(place: Place) -> None:
    async with Court(place) as court:
        validator, robot = await court.validator(), await court.robot()
        validator.settings = place.settings("juror-0", objective_size_limit=600)
        async with court.at_work(validator, robot) as person:
            contract = await court.demand(person, validator.address)
            await until_found(contract.reports, what="the report")
            outcome = await contract.outcome()
            assert (outcome.success, outcome.code) == (False, "content-too-large")

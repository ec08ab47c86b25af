"""What promisee and promisor see of a validator: its announcement before they agree, and its verdict with reasons."""

from __future__ import annotations

import asyncio
import logging
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from mesh import (
    XRT,
    AnnouncedValidator,
    Declined,
    Outcome,
    PolicyNote,
    Progress,
    ValidatorReport,
    ValidatorSilent,
    Verified,
)
from mesh.agent.ledger import Phase
from mesh.chain import UnsafeValidator
from mesh.errors import InputError
from mesh.watching.market import QUERY_LIMITS
from schemas import Demand, ReportKey, Result, Signer, decode
from tests.support.agent.trades import OBJECTIVE, job, working
from tests.support.jurors import COMPLETE, MISSING, Juror
from tests.support.log_events import logged_facts
from tests.support.market import Place, in_phase
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh import Agent, Contract

STRANGER = Signer(b"\x07" * 32)


def juror_of(place: Place, **fields: Any) -> Juror:
    """In generation 3: the account of the market's provider, which has ether."""
    signer = place.market.accounts["provider"].signer
    return Juror(endpoint=place.endpoint, lighthouse=place.market.deployment.lighthouse_name, signer=signer, **fields)


async def signed_result(robot: Agent, contract: Contract) -> Result:
    """The result that a robot has signed."""
    await in_phase(robot, contract, Phase.COMPLETE)
    results = [decode(one.payload) for one in await robot.parts.ledger.outbox(head=0)]
    (result,) = [one for one in results if isinstance(one, Result) and one.liability == contract.address]
    return result


async def judge(place: Place, juror: Juror, robot: Agent, contract: Contract, *, success: bool) -> ValidatorReport:
    """Report, and end the contract, as a validator of generation 3 does."""
    result = await signed_result(robot, contract)
    report = juror.judge(contract, result.result, success=success)
    await until_found(lambda: contract.reports(), what="the report")
    await place.chains["provider"].liabilities.validate(result, agree=success)
    return report


@asynccontextmanager
async def validated(place: Place, robot: Agent, juror: Juror) -> AsyncIterator[tuple[Agent, Contract]]:
    """A person's agent, and a contract under the juror, at the fee that it announces."""
    async with juror, place.at_work(working(robot)) as person:
        yield person, await person.demand(job(place), cost=5, validator=juror.signer.address)


async def test_both_parties_see_how_the_validator_judges_and_that_the_work_counts(place: Place) -> None:
    seen: list[AnnouncedValidator | None] = []
    told: list[ValidatorReport] = []
    heard: list[Progress] = []
    robot = place.agent("robot")

    @robot.on_demand
    async def look(demand: Verified[Demand]) -> None:
        seen.append(await robot.validator(demand))

    @robot.on_report
    async def remember(report: ValidatorReport) -> None:
        told.append(report)

    async with validated(place, robot, juror := juror_of(place)) as (_, contract):
        assert (contract.liability.validator, contract.liability.validator_fee) == (juror.signer.address, juror.fee)
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        report = await judge(place, juror, robot, contract, success=True)
        facts: dict[str, Any] = {"robot": robot.address, "contract": contract.address}
        expected = Outcome(success=True, result=report.result, reports=(report,), **facts)
        assert await ending == expected
        await until(lambda: told == [report])
    assert seen[0] is not None
    assert (seen[0].title, seen[0].policies, seen[0].fee) == (juror.title, (COMPLETE,), juror.fee)
    said = [one for one in heard if one.kind in ("judged", "paid")]
    assert [one.kind for one in said] == ["judged", "paid"]
    assert (said[0].agent, said[0].code, said[0].position, said[0].total) == (juror.signer.address, "", 1, 1)


async def test_a_refusal_gives_its_reason_to_both(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    heard: list[Progress] = []
    robot = place.agent("robot")
    async with validated(place, robot, juror := juror_of(place)) as (_, contract):
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        report = await judge(place, juror, robot, contract, success=False)
        outcome = await ending
        await until(lambda: len(logged_facts(caplog, "result-judged")) == 2, what="the report at both")
    assert (outcome.success, outcome.code, outcome.reports) == (False, MISSING.code, (report,))
    assert MISSING.detail in outcome.reason
    judged = next(one for one in heard if one.kind == "judged")
    assert (judged.code, MISSING.detail in judged.detail) == (MISSING.code, True)
    facts = {"juror": juror.signer.address, "success": "False", "codes": MISSING.code}
    assert [facts.items() <= one.items() for one in logged_facts(caplog, "result-judged")] == [True, True], "both"


async def test_reports_of_others_do_not_count(place: Place) -> None:
    robot = place.agent("robot")
    async with validated(place, robot, juror := juror_of(place)) as (person, contract):
        true = juror.report(contract.liability, (await signed_result(robot, contract)).result, success=True)
        forged = replace(true, juror=STRANGER.address).signed_by(STRANGER)
        stolen = replace(true, success=False)  # the juror's signature, of something else
        elsewhere = replace(true, liability=person.address).signed_by(juror.signer)
        unplanned = replace(true, objective=true.result).signed_by(juror.signer)
        for report in (forged, stolen, elsewhere, unplanned):
            juror.publish(report, person.address, robot.address)
        place_key = str(ReportKey(juror.lighthouse, person.address))
        person.channel.put(place_key, b"nonsense")
        assert await contract.reports() == ()
        await until(lambda: person.drops.totals().get("reports", 0) > 0)
        juror.publish(true, person.address, robot.address)
        await until_found(lambda: contract.reports(), what="the true report")
        assert await contract.reports() == (true,)


async def test_what_was_missed_is_asked_for(place: Place, caplog: pytest.LogCaptureFixture) -> None:
    """The report is published while nobody listens; the jurors still answer."""
    caplog.set_level(logging.INFO)
    async with juror_of(place) as juror, place.provider():
        async with working(place.agent("robot")) as robot, place.agent("person") as person:
            contract = await person.demand(job(place), cost=5, validator=juror.signer.address)
            result = await signed_result(robot, contract)
        juror.publish(juror.report(contract.liability, result.result, success=False))
        caplog.clear()
        async with working(place.agent("robot")):
            await until(lambda: bool(logged_facts(caplog, "result-judged")))
        async with place.agent("person") as reader:
            again = await reader.contract(contract.address)
            assert await again.reports() == tuple(juror.served)


async def test_those_who_wait_are_told_that_the_validator_is_silent(place: Place) -> None:
    heard: list[Progress] = []
    robot = place.agent("robot")
    async with validated(place, robot, juror := juror_of(place)) as (person, contract):
        person.runtime.reports.silence = 0.2
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        await until(lambda: any(one.kind == "unjudged" for one in heard))
        unjudged = next(one for one in heard if one.kind == "unjudged")
        refundable = await place.chains["person"].liabilities.refundable_from(contract.address)
        assert (unjudged.agent, unjudged.code) == (juror.signer.address, "silent")
        assert (unjudged.position, unjudged.total) == (0, 1)
        assert f"from block {refundable:,}" in unjudged.detail
        again: list[Progress] = []
        late = asyncio.create_task(
            contract.outcome(on_progress=again.append)
        )  # who comes late is told what has happened
        await until(lambda: {"result", "unjudged"} <= {one.kind for one in again})
        await judge(place, juror, robot, contract, success=True)
        assert (await ending).success
        assert (await late).success


async def test_a_fee_is_not_guessed_when_nobody_announces_one(place: Place) -> None:
    silent = place.address("provider")
    async with place.agent("person") as person:
        assert (await person.validator(silent)).is_silent
        with pytest.raises(ValidatorSilent):
            await person.order(OBJECTIVE, cost=5, validator=silent)
        with pytest.raises(UnsafeValidator):
            await person.order(OBJECTIVE, cost=5, validator=place.market.deployment.lighthouse)
        assert person.orders() == []
        order = await person.order(OBJECTIVE, cost=5, validator=silent, validator_fee="3wn")
        assert isinstance(order.message, Demand)
        assert order.message.validator_fee == 3


async def test_a_robot_does_not_work_for_a_demand_that_pays_its_validator_too_little(place: Place) -> None:
    """The validator would refuse the work."""
    async with juror_of(place) as juror, place.agent("person") as person, working(place.agent("robot")) as robot:
        for fee, works in ((juror.fee - 1, False), (juror.fee, True)):
            order = await person.order(job(place), cost=1, validator=juror.signer.address, validator_fee=fee)
            demand = order.message
            assert isinstance(demand, Demand)
            if works:
                assert await robot.offer(demand)
                continue
            with pytest.raises(Declined) as caught:
                await robot.offer(demand)
            assert caught.value.reason == "validator-underpaid"


@pytest.mark.parametrize(
    ("fields", "counts"),
    [
        ({}, True),
        ({"made_at": 60}, True),
        ({"made_at": QUERY_LIMITS.oldest + 60}, False),
        ({"made_at": -3600}, False),
        ({"validator": "stranger"}, False),
        ({"juror": "stranger"}, False),
        ({"signature": "another's"}, False),
    ],
)
async def test_only_recent_announcements_of_a_juror_count(place: Place, fields: dict[str, Any], counts: bool) -> None:
    class Odd(Juror):
        def announcement(self, **given: Any) -> Any:
            made_at = {"made_at": int(super().announcement().made_at - fields.get("made_at", 0))}
            named = {key: STRANGER.address for key in ("validator", "juror") if key in fields}
            return super().announcement(**made_at, **named)

        def _announce(self, query: Any) -> None:
            signer = STRANGER if "signature" in fields or "juror" in fields else self.signer
            query.reply(str(query.key_expr), b"nonsense")
            query.reply(str(query.key_expr), self.announcement().signed_by(signer).encode())

    like = juror_of(place)
    async with (
        Odd(endpoint=like.endpoint, lighthouse=like.lighthouse, signer=like.signer),
        place.agent("person") as asker,
    ):
        found = await asker.validator(like.signer.address)
        assert (not found.is_silent) is counts


async def test_an_agent_works_only_under_validators_that_it_accepts(place: Place) -> None:
    juror, other = place.address("provider"), place.address("person")
    async with place.agent("person") as person:
        order = await person.order(job(place), cost=1, validator=juror, validator_fee=0)
        demand = order.message
        assert isinstance(demand, Demand)
        for accepted, works in (("any", True), ("none", False), (other, False), (f"{other}, {juror}", True)):
            async with working(place.agent("robot", accepted_validators=accepted)) as robot:
                if works:
                    assert await robot.offer(demand)
                    continue
                with pytest.raises(Declined) as caught:
                    await robot.offer(demand)
                assert caught.value.reason == "validator-not-accepted"


def test_the_fee_of_several_jurors_is_what_the_quorum_asks() -> None:
    jurors = [Signer(bytes([number]) * 32) for number in (1, 2, 3)]
    other = PolicyNote(name="rate", description="ten messages a second")
    announcements = tuple(
        Juror(endpoint="", lighthouse="", signer=signer, validator=STRANGER.address, fee=fee).announcement(
            policies=(COMPLETE, other) if fee == 30 else (COMPLETE,)
        )
        for signer, fee in zip(jurors, (30, 10, 20), strict=True)
    )
    found = AnnouncedValidator(address=STRANGER.address, announcements=announcements, jurors=5, quorum=2)
    assert (found.fee, found.has_quorum, found.is_unanimous) == (20, True, False)
    assert found.policies == (COMPLETE, other)
    assert "3 of 5 jurors answer" in repr(found)
    assert XRT.show(20) in repr(found)


@asynccontextmanager
async def under_a_jury(place: Place) -> AsyncIterator[tuple[Juror, Juror, Agent, Agent, Contract]]:
    """A contract of generation 5 between robot and person, whose two jurors must judge alike."""
    signers = [Signer(bytes([number]) * 32) for number in (21, 22)]
    jury = await place.chains["person"].validators.deploy([signer.address for signer in signers], 2)
    first, second = (juror_of(place, validator=jury.address, fee=fee, jurors=2, quorum=2) for fee in (100, 50))
    first.signer, second.signer = signers
    robot = working(place.agent("robot", generation=5))
    async with first, second, place.provider(), robot, place.agent("person", generation=5) as person:
        contract = await person.demand(job(place), cost=5, validator=first.validator)
        yield first, second, robot, person, contract


async def test_jurors_that_disagree_are_shown_to_both(place: Place) -> None:
    heard: list[Progress] = []
    async with under_a_jury(place) as (first, second, robot, person, contract):
        person.runtime.reports.silence = 0.3
        announced = await person.validator(first.validator)
        assert (announced.jurors, announced.quorum, announced.fee, announced.has_quorum) == (2, 2, 100, True)
        assert contract.liability.validator_fee == 100
        ending = asyncio.create_task(contract.outcome(on_progress=heard.append))
        result = await signed_result(robot, contract)
        await until(lambda: any(one.kind == "unjudged" for one in heard), what="the person's knowledge of the result")
        first.judge(contract, result.result, success=True)
        await until(lambda: [one.position for one in heard if one.kind == "unjudged"][-1:] == [1])
        second.judge(contract, result.result, success=False)
        await until(lambda: any(one.code == "disagree" for one in heard))
        votes = [(one.kind, one.code, one.position, one.total) for one in heard if "judged" in one.kind]
        assert [vote for vote in votes if vote[2]] == [
            ("judged", "", 1, 2),
            ("unjudged", "silent", 1, 2),
            ("judged", MISSING.code, 1, 2),
            ("unjudged", "disagree", 1, 2),
        ]
        assert {one.juror for one in await contract.reports()} == {first.signer.address, second.signer.address}
        ending.cancel()


async def test_a_report_of_a_stranger_to_the_jury_does_not_count(place: Place) -> None:
    async with under_a_jury(place) as (first, _, robot, person, contract):
        stranger = Juror(endpoint="", lighthouse=first.lighthouse, signer=STRANGER, validator=first.validator)
        false = stranger.report(contract.liability, OBJECTIVE, success=False)
        first.publish(false, person.address, robot.address)
        await until(lambda: person.drops.totals().get("reports", 0) > 0)
        assert await contract.reports() == ()


async def test_an_allowance_that_covers_the_price_alone_is_no_reason_to_leave_out_the_permit(place: Place) -> None:
    person = place.chains["person"]
    await person.tokens.approve(person.factory, 50)
    async with asyncio.timeout(60), under_a_jury(place) as (_, _, _, _, contract):
        assert (contract.liability.cost, contract.liability.validator_fee) == (5, 100)


async def test_a_validator_without_code_is_refused_before_anything_is_signed(place: Place) -> None:
    async with place.agent("person", generation=5) as person:
        with raises_with(InputError, code="validator-without-code"):
            await person.order(OBJECTIVE, cost=5, validator=STRANGER.address)
        assert person.orders() == []

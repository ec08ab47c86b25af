"""The signer over its sockets, in a market with a router, a provider, a chain and a robot."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.hiring import Hiring
from mesh.base.flood import Rate
from mesh.errors import ConfigurationError
from mesh.signer.protocol import SignerError
from mesh.signer.service import REQUEST_LIMITS, SIGNED_ORDER_LIMITS, TICK
from tests.support.signer.signers import GOOD, ended, reached

if TYPE_CHECKING:
    from tests.support.signer.signers import Driver, Person


async def test_a_job_is_found_priced_ordered_watched_and_verified(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, owner, _):
        (robot,) = (await door.find_robots(model=driver.model)).robots
        assert (robot.address, robot.name.text, robot.is_allowed) == (driver.agent.address, "Rover", True)
        assert robot.name.author == f"robot {robot.address}"
        described = await door.describe_model(driver.model)
        fields = {field.path: field for topic in described.topics for field in topic.fields}
        assert fields["radius"].allowed[0].maximum == 2.0
        quotes = await door.quote(model=driver.model, messages=[GOOD])
        assert [(one.cost.text, one.verdict) for one in quotes.quotes] == [("1 XRT", "allowed")]
        job = await door.order(model=driver.model, messages=[GOOD], cost="2 XRT", idempotency_key="first")
        assert job.state == "ordering"
        job = await ended(door, job)
        assert (job.state, job.cost.text, job.robot) == ("done", "1 XRT", robot.address)
        assert await person.spent() == 10**9
        recording = await door.recording(job.job_id)
        assert "/odometry" in {topic.topic.text for topic in recording.topics}
        values = await door.recording(job.job_id, topic="/odometry")
        assert values.values[0].value.text == '{"radius":1.0}'
        assert (await door.verify(job.job_id)).holds
        balance = await door.balance()
        assert (balance.hour_left.text, balance.jobs) == ("19 XRT", 0)
        assert [entry.contract for entry in (await door.statement()).entries] == [job.contract]
        events = [entry.event for entry in (await owner.log()).entries]
        assert events == ["started", "allowed", "ordered", "contract", "ended"]
        assert (await owner.verify_log()).holds


async def test_one_key_is_one_contract_also_at_once_and_after_a_restart(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    order: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "1 XRT", "idempotency_key": "k"}
    async with person.at_work() as (door, _, _):
        jobs = await asyncio.gather(*(door.order(**order) for _ in range(5)))
        assert len({job.job_id for job in jobs}) == 1
        done = await ended(door, jobs[0])
    async with person.at_work() as (door, _, _):
        again = await door.order(**order)
        assert (again.job_id, again.contract) == (done.job_id, done.contract)
        with pytest.raises(SignerError) as caught:
            await door.order(**{**order, "cost": "2 XRT"})
        assert caught.value.code == "idempotency-conflict"
        assert await person.spent() == 10**9
    assert len(driver.begun) == 1


async def test_a_consent_is_for_one_order_is_used_once_and_not_given_by_a_door(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    order: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "4 XRT"}
    async with person.at_work() as (door, owner, _):
        job = await door.order(**order, idempotency_key="dear")
        assert job.state == "needs-consent"
        assert job.consent is not None
        with pytest.raises(SignerError) as caught:
            await door.approve(job.consent.id)
        assert caught.value.code == "unknown-operation"
        with pytest.raises(SignerError) as caught:
            await owner.approve("consent-0000000000000000")
        assert caught.value.code == "consent-unknown"
        (shown,) = await owner.consents()
        assert (shown.id, shown.cost.text, shown.messages[0].text) == (
            job.consent.id,
            "4 XRT",
            '/drive {"radius":1.0,"direction":"left"}',
        )
        assert (await door.job(job.job_id)).state == "needs-consent"
        approved = await owner.approve(job.consent.id)
        assert approved.state == "ordering"
        with pytest.raises(SignerError, match="allowed before") as caught:
            await owner.approve(job.consent.id)
        assert caught.value.code == "consent-used"
        assert (await ended(door, approved)).state == "done"
        other = await door.order(**order, idempotency_key="dearer")
        assert other.consent is not None
        assert (await owner.deny(other.consent.id)).state == "denied"
        with pytest.raises(SignerError, match="denied before") as caught:
            await owner.approve(other.consent.id)
        assert caught.value.code == "consent-used"
    assert len(driver.begun) == 1


async def test_a_race_for_the_last_of_a_budget_has_one_winner(person: Person, driver: Driver) -> None:
    limits = '[budget]\nper_job = "1 XRT"\nper_hour = "3 XRT"\nper_day = "3 XRT"\njobs_at_a_time = 10\n'
    person.allow(driver.model, limits=limits)
    async with person.at_work() as (door, _, _):
        order: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "1 XRT"}
        found = await asyncio.gather(
            *(door.order(**order, idempotency_key=f"k{number}") for number in range(8)), return_exceptions=True
        )
        jobs = [one for one in found if not isinstance(one, BaseException)]
        codes = {one.code for one in found if isinstance(one, SignerError)}
        assert (len(jobs), codes) == (3, {"hour-budget-spent"})
        for job in jobs:
            assert (await ended(door, job, seconds=90)).state == "done"
        assert await person.spent() == 3 * 10**9


async def test_a_job_is_stopped_and_its_refund_frees_no_budget(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    driver.released.clear()
    async with person.at_work() as (door, _, _):
        job = await door.order(model=driver.model, messages=[GOOD], cost="1 XRT", idempotency_key="k")
        job = await reached(door, job, lambda one: one.latest)
        assert job.latest[0].value.text == '{"radius":1.0}'
        assert (await door.jobs())[0].latest == ()
        with pytest.raises(SignerError) as caught:
            await door.withdraw(job.job_id)
        assert caught.value.code == "already-a-contract"
        job = await ended(door, await door.stop_job(job.job_id, why="enough"))
        assert job.state == "stopped"
        assert await person.spent() == 0
        assert (await door.balance()).hour_left.text == "19 XRT"


async def test_a_robot_that_says_much_does_not_keep_others_from_being_heard(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    driver.released.clear()
    async with person.at_work() as (door, owner, signer):
        job = await door.order(model=driver.model, messages=[GOOD], cost="1 XRT", idempotency_key="k")
        job = await reached(door, job, lambda one: one.latest)
        before = job.revision
        loop = asyncio.get_running_loop()
        began = loop.time()
        while job.revision < before + 3:  # the robot says something twenty times a second
            job = await door.job(job.job_id, revision=job.revision, wait_seconds=5.0)
        assert loop.time() - began >= 2 * TICK
        for _ in range(REQUEST_LIMITS.at_a_time):
            await signer._places.acquire()
        assert await owner.consents() == ()
        await door.stop_job(job.job_id)
        assert signer._places.locked()
        driver.released.set()
        for _ in range(REQUEST_LIMITS.at_a_time):
            signer._places.release()
        job = await ended(door, job)
        assert job.state == "stopped"
        assert job.error is not None
        assert job.error.message == "the job was stopped, and its cost came back"


async def test_many_orders_are_too_many_and_one_that_was_made_is_still_answered(
    person: Person, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    person.allow(driver.model)
    rate = Rate(per_second=0.001, burst=2)
    monkeypatch.setattr("mesh.signer.service.SIGNED_ORDER_LIMITS", SIGNED_ORDER_LIMITS._replace(rate=rate))
    order: dict[str, Any] = {"model": driver.model, "messages": [GOOD]}
    async with person.at_work() as (door, owner, _):
        job = await door.order(**order, cost="4 XRT", idempotency_key="k")
        for key, code in (("a", "too-expensive"), ("b", "too-many-requests")):
            with pytest.raises(SignerError) as caught:
                await door.order(**order, cost="50 XRT", idempotency_key=key)
            assert caught.value.code == code
        assert (await door.order(**order, cost="4 XRT", idempotency_key="k")).job_id == job.job_id
        assert [one.event for one in (await owner.log()).entries] == ["started", "consent-needed", "refused"]


async def test_a_model_is_named_by_its_cid(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, _, _):
        with pytest.raises(SignerError, match="'Rover' is no model's CID or name") as caught:
            await door.describe_model("Rover")
    assert (caught.value.code, caught.value.hint) == ("invalid-cid", "find_robots has the CIDs")


async def test_strangers_text_is_marked_and_made_harmless(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, _, _):
        message = ("/drive", {"radius": 1, "direction": "left", "label": "fail"})
        job = await door.order(model=driver.model, messages=[message], cost="1 XRT", idempotency_key="k")
        job = await ended(door, job)
        assert job.state == "refunded"
        assert job.error is not None
        assert job.error.from_strangers is not None
        assert job.error.from_strangers.text == "the wheel is loose"
        assert job.error.code == "wheel-loose"


async def test_a_second_signer_in_one_folder_refuses(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work():
        with pytest.raises(ConfigurationError) as caught:
            await person.signer().__aenter__()
        assert caught.value.code == "signer-running"


async def test_an_order_that_is_taken_back_binds_its_cost_until_its_deadline(
    person: Person, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    person.allow(driver.model)
    monkeypatch.setattr(Hiring, "send", lambda *_: None)  # no provider gets it
    async with person.at_work() as (door, _, signer):
        job = await door.order(
            model=driver.model, messages=[GOOD], cost="1 XRT", idempotency_key="k", deadline_seconds=30
        )
        job = await reached(door, job, lambda one: one.state == "waiting")
        with pytest.raises(SignerError) as caught:
            await door.stop_job(job.job_id)
        assert caught.value.code == "not-a-contract"
        assert (await door.withdraw(job.job_id)).state == "withdrawn"
        balance = await door.balance()
        assert (balance.hour_left.units, balance.jobs) == (19 * 10**9, 0)
        record = signer.budget.job(job.job_id)
        assert record is not None
        head = await person.chain.node.contract_blocks.last(await person.chain.block_number())
        await person.market.mine(record.deadline - head + 1)
        async with asyncio.timeout(30):
            while (await door.balance()).hour_left.units != 20 * 10**9:
                await asyncio.sleep(0.1)
        assert (await door.job(job.job_id)).state == "withdrawn"
    assert await person.spent() == 0


async def test_an_order_that_waits_for_a_yes_can_be_taken_back(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, owner, _):
        job = await door.order(model=driver.model, messages=[GOOD], cost="4 XRT", idempotency_key="k")
        assert job.consent is not None
        assert (await door.withdraw(job.job_id)).state == "withdrawn"
        with pytest.raises(SignerError, match="taken back") as caught:
            await owner.approve(job.consent.id)
        assert caught.value.code == "consent-used"

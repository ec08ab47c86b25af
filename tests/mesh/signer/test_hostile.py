"""Each attempt of the table `hostile.CASES` is refused with its code and logged; nothing is signed and nothing paid."""

from __future__ import annotations

import asyncio
import io
import json
import os
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest

from mesh.errors import AiraError
from mesh.recording import messages_in, pack
from mesh.signer.client import CALL_LIMITS
from mesh.signer.protocol import SignerError
from tests.support.signer.hostile import CASES
from tests.support.signer.signers import GOOD, LIMITS, ended

if TYPE_CHECKING:
    from tests.support.signer.signers import Driver, Person


async def test_every_case_is_refused_with_its_code_and_logged(person: Person, driver: Driver) -> None:
    person.allow(driver.model, robots=f'["{driver.agent.address}"]')
    good: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "1 XRT"}
    found: dict[str, str] = {}
    async with person.at_work() as (door, owner, _):
        for case in CASES:
            try:
                job = await door.order(**good | case.order, idempotency_key=case.name)
                found[case.name] = job.state
            except AiraError as error:
                found[case.name] = error.code
        assert [(case.tried, found[case.name]) for case in CASES if found[case.name] != case.code] == []
        assert await door.jobs() == ()
        refused = [one.facts for one in (await owner.log(limit=1000)).entries if one.event == "refused"]
        assert {one["key"]: one["code"] for one in refused} == found
        assert (await owner.verify_log()).holds
    assert await person.spent() == 0
    assert driver.begun == []


async def test_an_objective_by_cid_is_judged_by_what_is_in_it(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    lines = {
        "good": [b'{"topic": "/drive", "value": {"radius": 1, "direction": "left"}}'],
        "above": [b'{"topic": "/drive", "value": {"radius": 3, "direction": "left"}}'],
        "other type": [b'{"topic": "/drive", "type": "application/octet-stream", "value": "AAAA"}'],
        "text": [b'{"topic": "/drive", "type": "std_msgs/String", "value": "left"}'],
    }
    order: dict[str, Any] = {"model": driver.model, "cost": "1 XRT"}
    async with person.at_work() as (door, _, _):
        codes: dict[str, str] = {}
        for name, text in lines.items():
            path = person.folder / "objective.mcap"
            pack(messages_in(text), path)
            cid = await driver.agent.add(path)
            try:
                job = await door.order(**order, objective=cid, idempotency_key=name)
                codes[name] = (await ended(door, job)).state
            except SignerError as error:
                codes[name] = error.code
        twice = b'{"radius": 1, "direction": "left", "radius": 3}'
        path = person.folder / "twice.mcap"
        (message,) = messages_in([b'{"topic": "/drive", "value": {"radius": 1}}'])
        pack([type(message)("/drive", twice, 0, 0, 0, message.type)], path)
        with pytest.raises(SignerError) as caught:
            await door.order(**order, objective=await driver.agent.add(path), idempotency_key="twice")
        assert caught.value.code == "field-not-allowed"
    refused = "value-not-allowed"
    assert codes == {"good": "done", "above": refused, "other type": refused, "text": refused}
    assert len(driver.begun) == 1


async def test_what_is_no_request_is_refused(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    good = {"model": driver.model, "messages": [{"topic": "/stop"}], "cost": "1 XRT", "idempotency_key": "k"}
    bodies: list[tuple[bytes, str]] = [
        (b"{", "invalid-request"),
        (b'{"radius": NaN}', "invalid-request"),
        (json.dumps(good | {"policy": "none"}).encode(), "invalid-request"),
        (json.dumps(good | {"approved": True}).encode(), "invalid-request"),
        (json.dumps(good | {"deadline_seconds": 10**9}).encode(), "invalid-request"),
        (json.dumps(good | {"idempotency_key": ""}).encode(), "invalid-request"),
        (json.dumps(good | {"cost": 1}).encode(), "invalid-request"),
        (b'{"messages":' + b"[" * 5000 + b"]" * 5000 + b"}", "invalid-request"),
    ]
    async with person.at_work() as (door, _, signer):
        connector = aiohttp.UnixConnector(path=str(signer.door))
        async with aiohttp.ClientSession(connector=connector) as session:
            for body, code in bodies:
                async with session.post("http://signer/v1/order", data=body) as response:
                    assert response.status == 400
                    assert (await response.json())["error"]["code"] == code
            for operation in ("approve", "deny", "use_policy", "log", "consents", "policy", "__init__", "do_order"):
                async with session.post(f"http://signer/v1/{operation}", data=b"{}") as response:
                    assert (await response.json())["error"]["code"] == "unknown-operation"
            async with session.post("http://signer/v1/order", data=io.BytesIO(b" " * (2 << 20))) as response:
                assert response.status == 413
        assert await door.jobs() == ()
        modes = [os.stat(path).st_mode & 0o777 for path in (signer.door, signer.owner, signer.folder)]
        assert modes == [0o600, 0o600, 0o700]


async def test_a_flood_of_requests_is_refused(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, _, _):
        found = []
        for _ in range(10):
            found += await asyncio.gather(*(door.jobs() for _ in range(CALL_LIMITS.calls)), return_exceptions=True)
        assert {one.code for one in found if isinstance(one, SignerError)} == {"too-many-requests"}


async def test_a_clock_that_is_set_back_frees_no_budget(person: Person, driver: Driver) -> None:
    person.allow(driver.model, limits='[budget]\nper_job = "1 XRT"\nper_hour = "1 XRT"\nper_day = "1 XRT"\n')
    import time

    order: dict[str, Any] = {"model": driver.model, "messages": [GOOD], "cost": "1 XRT"}
    async with person.at_work():
        pass  # the time is known
    for number, shift in enumerate((-86_400.0 * 3, 0.0, -86_400.0, 1_800.0)):
        async with person.at_work(clock=lambda shift=shift: time.time() + shift) as (door, owner, _):
            if not number:
                await ended(door, await door.order(**order, idempotency_key="first"))
            with pytest.raises(SignerError) as caught:
                await door.order(**order, idempotency_key=f"again {number}")
            assert caught.value.code == "hour-budget-spent"
    async with person.at_work(clock=lambda: time.time() + 86_500.0) as (door, owner, _):
        assert (await door.balance()).hour_left.text == "1 XRT"
    async with person.at_work() as (door, owner, _):  # that was a wrong clock: the owner says so, and nothing is free
        await owner.use_policy()
        with pytest.raises(SignerError) as caught:
            await door.order(**order, idempotency_key="last")
        assert caught.value.code == "hour-budget-spent"
    assert await person.spent() == 10**9


async def test_a_policy_that_was_swapped_counts_only_when_the_owner_says_so(person: Person, driver: Driver) -> None:
    person.allow(driver.model)
    async with person.at_work() as (door, owner, _):
        before = await owner.policy()
        needs = await door.order(model=driver.model, messages=[GOOD], cost="4 XRT", idempotency_key="consent")
        assert needs.consent is not None
        person.allow(driver.model, limits=LIMITS.replace('per_job = "5 XRT"', 'per_job = "9 XRT"'))
        with pytest.raises(SignerError) as caught:
            await door.order(model=driver.model, messages=[GOOD], cost="8 XRT", idempotency_key="k")
        assert caught.value.code == "too-expensive"
        person.policy.chmod(0o666)
        with pytest.raises(SignerError, match="others may write to it") as caught:
            await owner.use_policy()
        assert (caught.value.code, "chmod" in caught.value.hint) == ("policy-unsafe", True)
        person.policy.chmod(0o600)
        text = person.policy.read_text()
        person.policy.write_text(text.replace("per_hour", "per_our"))
        with pytest.raises(SignerError, match="did you mean per_hour") as caught:
            await owner.use_policy()
        assert (caught.value.code, "policy check" in caught.value.hint) == ("invalid-policy", True)
        person.policy.write_text(text)
        assert (await owner.policy()).hash == before.hash
        used = await owner.use_policy()
        assert used.hash != before.hash
        assert (await owner.log()).entries[-1].facts == {"policy": used.hash}
        with pytest.raises(SignerError, match="the owner changed the policy") as caught:
            await owner.approve(needs.consent.id)
        assert caught.value.code == "policy-changed"
        assert (await door.job(needs.job_id)).state == "denied"


async def test_a_consent_expires(person: Person, driver: Driver) -> None:
    import time

    moved = 0.0
    person.allow(driver.model)
    async with person.at_work(clock=lambda: time.time() + moved) as (door, owner, _):
        job = await door.order(model=driver.model, messages=[GOOD], cost="4 XRT", idempotency_key="k")
        assert job.consent is not None
        moved = 601.0
        consent = job.consent.id
        for _ in range(2):  # before the signer has noted it, and after
            with pytest.raises(SignerError) as caught:
                await owner.approve(consent)
            assert (caught.value.code, "new key" in caught.value.hint) == ("consent-expired", True)
            job = await ended(door, job)
        assert job.state == "expired"
        assert job.error is not None
        assert "new key" in job.error.next
    assert driver.begun == []


async def test_an_order_that_was_changed_after_it_was_shown_is_not_approved(person: Person, driver: Driver) -> None:
    import msgspec

    person.allow(driver.model)
    async with person.at_work() as (door, owner, signer):
        job = await door.order(model=driver.model, messages=[GOOD], cost="4 XRT", idempotency_key="k")
        assert job.consent is not None
        record = signer.budget.job(job.job_id)
        assert record is not None
        signer.budget.put(msgspec.structs.replace(record, cost=5 * 10**9))
        with pytest.raises(SignerError) as caught:
            await owner.approve(job.consent.id)
        assert caught.value.code == "consent-void"

"""The page shows how a validator judges before a demand is signed, and how it judged a job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh import XRT
from schemas import ReportKey, keccak256
from schemas.signing import recover
from tests.mesh.agent.test_validated_contracts import judge, juror_of
from tests.support.agent.trades import job, working
from tests.support.jurors import COMPLETE, MISSING, Juror
from tests.support.market import MODEL
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from tests.support.market import Place


async def once_online(browser: Any, juror: Juror) -> Any:
    """What the page knows of a validator once its juror is present and has announced itself."""

    async def online() -> Any:
        said = await browser.get(f"validators/{juror.signer.address}")
        return said if said["online"] and said["announcements"] else None

    return await until_found(online, what="the juror")


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
            is_judged = any(step["kind"] == "judged" for step in shown["timeline"])
            return shown if is_judged and shown["liability"]["state"] == "failed" else None

        shown = await until_found(refused, what="the refusal")
        (judged,) = [step for step in shown["timeline"] if step["kind"] == "judged"]
        assert judged["agent"] == report.juror
        assert MISSING.detail in judged["detail"]
        assert (shown["reason"]["code"], MISSING.detail in shown["reason"]["text"]) == (MISSING.code, True)


async def test_the_page_says_how_a_validator_judges_before_a_demand_is_signed(place: Place, serve: Any) -> None:
    async with juror_of(place) as juror, serve() as browser:
        said = await once_online(browser, juror)
        assert (said["title"], said["online"]) == (juror.title, [juror.signer.address])
        assert said["policies"] == [{"name": COMPLETE.name, "description": COMPLETE.description}]
        assert (said["announcedFee"], said["fee"], said["doubts"]) == ("100", "100", {})
        assert "refund" in said["refund"]
        (signed,) = said["announcements"]  # what a browser checks without the server
        hashed = keccak256(b"aira validator\0" + signed["text"].encode())
        assert recover(hashed, signed["signature"]) == juror.signer.address
        assert msgspec.json.decode(signed["text"])["title"] == juror.title
        cheap = await browser.get(f"validators/{juror.signer.address}", fee="99")
        assert list(cheap["doubts"]) == ["low-fee"]
        assert "0.000000099 XRT" in cheap["doubts"]["low-fee"]
        named = await browser.get(f"validators/{place.market.deployment.lighthouse_name}", status=400)
        assert named["error"]["code"] == "validator-unsafe"


@pytest.mark.parametrize("doubt", ["silent", "low-fee"])
async def test_the_local_account_orders_from_no_doubtful_validator(place: Place, serve: Any, doubt: str) -> None:
    async with juror_of(place) as juror, serve("person") as browser:
        await once_online(browser, juror)
        await place.chains["robot"].validators.introduce()  # an account that could still become a contract is refused
        validator = juror.signer.address if doubt == "low-fee" else place.market.accounts["robot"].signer.address
        wanted = {"model": MODEL, "objective": MODEL, "cost": "5", "validator": validator, "validatorFee": "1"}
        refused = await browser.post("local/orders", wanted, status=400)
        assert refused["error"]["code"] == "validator-doubtful"
        words = {"silent": "nobody answers as this validator", "low-fee": f"wants {XRT.show(100)}"}[doubt]
        assert words in refused["error"]["message"]
        assert (await browser.get("orders"))["orders"] == []

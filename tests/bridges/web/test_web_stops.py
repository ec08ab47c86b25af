"""Stopping a job through the page's server: by the local account, by a wallet, and by nobody else."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from mesh import Job, ModelDescription, ModelTopic, String
from schemas.signing import StopRequest
from tests.bridges.web.test_page_server import DATA
from tests.bridges.web.test_web_robots import contract_of, made
from tests.support.market import MODEL, offering
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from mesh import Agent
    from tests.support.market import Place


def endless(robot: Agent) -> Agent:
    """The same robot, whose jobs never end."""

    @robot.on("*")
    async def go(job: Job, message: String) -> None:
        await asyncio.Event().wait()

    return offering(robot)


async def ordered(browser: Any, robot: Agent, model: str = MODEL) -> str:
    wanted = {"model": model, "objective": await made(browser), "cost": "7", "robot": robot.address}
    posted = await browser.post("local/orders", wanted, status=202)
    return await contract_of(browser, posted["order"]["hash"])


async def in_state(browser: Any, address: str, state: str) -> Any:
    async def reached() -> Any:
        job = await browser.get(f"liabilities/{address}")
        return job if job["liability"]["state"] == state else None

    return await until_found(reached, what=f"the state {state}")


async def running(browser: Any, address: str) -> Any:
    async def reached() -> Any:
        job = await browser.get(f"liabilities/{address}")
        return job if job["phase"] in ("ready", "running") else None

    return await until_found(reached, what="work")


async def test_the_local_account_stops_its_job_and_is_refunded(place: Place, serve: Any) -> None:
    async with place.provider(), endless(place.agent("robot")) as robot, serve("person") as browser:
        address = await ordered(browser, robot)
        job = await running(browser, address)
        assert (job["private"], job["stopped"], job["onStop"]) == (True, None, "")
        assert await browser.post("local/stops", {"liability": address, "why": "enough"}) == {"devices": []}
        person = place.address("person")
        job = await in_state(browser, address, "failed")
        assert job["stopped"] == {"by": person, "why": "enough"}
        ended = await browser.post("local/stops", {"liability": address, "why": ""}, status=502)
        assert ended["error"]["code"] == "liability-ended"
        await browser.post("local/stops", {"liability": person, "why": ""}, status=404)
        async with serve() as other:  # which was not there when it was stopped
            wanted = {"liability": address, "why": ""}
            assert (await other.post("local/stops", wanted, status=409))["error"]["code"] == "no-local-account"

            async def told() -> Any:
                return (await other.get(f"liabilities/{address}"))["stopped"]

            await other.get(f"files/{job['liability']['result']}/summary")
            assert await until_found(told, what="the reason") == {"by": person, "why": "enough"}


async def test_a_wallet_stops_its_job_and_a_stranger_does_not(place: Place, serve: Any) -> None:
    async with place.provider(), endless(place.agent("robot")) as robot, serve("person") as browser:
        address = await ordered(browser, robot)
        await running(browser, address)
        async with serve() as wallets:

            def signed(role: str, by: str = "person", why: str = "enough") -> Any:
                request = StopRequest(liability=address, by=place.address(by), why=why, time=int(time.time()))
                return request.signed_by(place.market.accounts[role].signer)

            for wrong in (signed("provider"), signed("provider", by="provider")):
                await wallets.post("stops", wrong.encode(), status=400)
            await wallets.post("stops", b"{}", status=400)
            assert (await running(wallets, address))["stopped"] is None
            assert await wallets.post("stops", signed("person").encode()) == {"devices": []}
            job = await in_state(wallets, address, "failed")
            assert job["stopped"] == {"by": place.address("person"), "why": "enough"}


async def test_a_job_says_what_its_model_says_of_stops(place: Place, serve: Any) -> None:
    model = ModelDescription(title="Cutter", objective=(ModelTopic(topic="/go"),), on_stop="paid")
    async with serve("person") as browser:
        cid = (await browser.post("objectives", model.encode(), headers=DATA))["cid"]
        async with place.provider(), offering(place.agent("robot", model=cid)) as robot:
            job = await browser.get(f"liabilities/{await ordered(browser, robot, cid)}")
            assert job["onStop"] == "paid"

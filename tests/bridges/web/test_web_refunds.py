"""Getting the money back: the local account's cost of a job that nobody finished."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from aiohttp import ClientSession

from bridges.web._access import WebOptions
from bridges.web.components import opened
from bridges.web.server import PageServer
from mesh.chain import DeploymentPlan
from mesh.testing import MarketChain
from tests.bridges.web.conftest import Browser
from tests.support.market import MODEL, Place, offering
from tests.support.objectives import objective
from tests.support.tokens import block, deploy_blocking_token
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

COST, DELAY = 5_000, 30
DATA = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}


@pytest.mark.parametrize("is_refused", [False, True], ids=["paid", "owed"])
async def test_the_cost_of_a_job_that_nobody_finishes_comes_back(
    router: EmbeddedRouter, tmp_path: Path, is_refused: bool
) -> None:
    plan = DeploymentPlan(refund_delay=DELAY, timeout_blocks=100)
    async with (
        MarketChain(plan) as chain,
        Place(chain, router.endpoint, tmp_path) as place,
        place.provider(),
        offering(place.agent("robot")) as robot,  # it has no handlers: its jobs wait for `start`
        opened(
            place.settings("person"), account=place.market.accounts["person"], chain=place.chains["person"]
        ) as components,
        PageServer(components, WebOptions(port=0, static=tmp_path)) as server,
        ClientSession() as session,
    ):
        browser, before = Browser(session, server), await place.balance("person")
        made = await browser.post("objectives", objective(("/blink", "on")), headers=DATA)
        wanted = {"model": MODEL, "objective": made["cid"], "cost": str(COST)}
        cost = COST
        if is_refused:
            wanted["token"] = token = await deploy_blocking_token(place.chains["person"], COST)
            await block(place.chains["person"], token, place.market.accounts["person"].address)
            await robot.control(least_price=f"1 {token}")
            cost = 0  # of XRT
        order = (await browser.post("local/orders", wanted, status=202))["order"]["hash"]

        async def matched() -> Any:
            return (await browser.get(f"orders/{order}"))["liability"]

        await until_found(matched, what="a contract")
        address = await matched()
        assert await place.balance("person") == before - cost
        early = await browser.post("local/refunds", {"liability": address}, status=502)
        assert early["error"]["code"] == "not-refundable"
        await place.node.mine(DELAY + 1)

        async def refunded() -> bool:
            async with session.post(
                f"{server.url}/api/v1/local/refunds", json={"liability": address}, headers={"X-Aira-Request": "1"}
            ) as response:
                is_here = response.status == 200
            # The provider or the person's agent may have been faster.
            return is_here or (await place.chains["provider"].liabilities.get(address)).state == "called-off"

        await until_found(refunded, what="the refund")
        assert await place.balance("person") == before

        async def ended() -> Any:
            return (await browser.get(f"liabilities/{address}"))["timeline"][-1]["kind"] == "refunded"

        await until_found(ended, what="the refund on the page")
        assert (await browser.get(f"liabilities/{address}"))["owed"] == (str(COST) if is_refused else "0")

"""The page's server: a whole job through its interface, at a real market."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

from schemas import ZERO_ADDRESS, Demand, encode
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from mesh import Job, String
    from mesh.chain import Account
    from tests.support.market import Place

COST = 5_000


async def signed_demand(browser: Any, account: Account, cid: str, *, cost: int = COST, lifetime: int = 200) -> bytes:
    """What the page signs with a wallet: built from what the server says of the market."""
    market = await browser.get("market")
    demand = Demand(
        model=MODEL,
        objective=cid,
        token=market["token"]["address"],
        cost=cost,
        lighthouse=market["lighthouse"]["address"],
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=market["block"] + lifetime,
        nonce=secrets.token_hex(32),
    )
    return encode(account.signer.sign(demand))


async def test_a_wallet_orders_and_follows_its_job_to_the_payment(place: Place, serve: Any) -> None:
    robot = offering(place.agent("robot"))

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        job.publish("/blinked", message.data)

    person = place.market.accounts["person"]
    async with place.provider(), robot, serve() as browser:
        data = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}
        made = await browser.post("objectives", objective(("/blink", "on"), ("/blink", "off")), headers=data)
        assert made["preflight"] == {"ok": True, "reason": "", "detail": ""}
        assert made["summary"]["messages"] == 2
        await place.chains["person"].tokens.approve(place.chains["person"].factory, COST)
        posted = await browser.post("orders", await signed_demand(browser, person, made["cid"]), status=202)
        order_hash = posted["order"]["hash"]
        assert posted["order"]["cost"] == str(COST)

        async def matched() -> Any:
            return (await browser.get(f"orders/{order_hash}"))["liability"]

        await until_found(matched, what="a contract")
        address = await matched()

        async def paid() -> Any:
            job = await browser.get(f"liabilities/{address}")
            return job if job["liability"]["state"] == "paid" else None

        await until_found(paid, what="a payment")
        job = await paid()
        assert job["phase"] == "finalized"
        assert job["timeline"][0]["kind"] == "created"
        assert job["timeline"][-1]["kind"] == "paid"
        assert job["resultMessage"]["signer"] == place.address("robot")
        verdict = await browser.get(f"liabilities/{address}/verification")
        assert verdict["holds"], verdict

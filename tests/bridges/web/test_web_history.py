"""What the page's server says of the past: statements, and the contracts of the market."""

from __future__ import annotations

import asyncio
import csv
import io
from typing import TYPE_CHECKING, Any

from bridges.web._views import time_between
from tests.bridges.web.test_page_server import COST
from tests.bridges.web.test_web_robots import contract_of, made
from tests.support.agent.trades import working
from tests.support.market import MODEL
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from tests.support.market import Place


async def test_what_an_account_has_earned_and_what_was_ordered_is_told(place: Place, serve: Any) -> None:
    person = place.address("person")
    async with place.provider(), working(place.agent("robot")) as robot, serve("person") as browser:
        addresses = []
        wanted = {"model": MODEL, "objective": await made(browser), "cost": str(COST)}
        for _ in range(2):
            posted = await browser.post("local/orders", wanted, status=202)
            addresses.append(address := await contract_of(browser, posted["order"]["hash"]))

        async def paid() -> Any:
            return (await browser.get(f"liabilities/{address}"))["liability"]["state"] == "paid"

        await until_found(paid, what="a payment")
        job = await browser.get(f"liabilities/{address}")
        history = await browser.get("market/history", model=MODEL)
        assert not history["truncated"]
        newest = history["jobs"][0]
        assert [one["address"] for one in history["jobs"][:2]] == addresses[::-1]
        assert [newest[name] for name in ("address", "cost", "state", "promisor", "promisee")] == [
            *(address, str(COST), "paid", robot.address, person)
        ]
        assert newest["block"] == job["timeline"][0]["block"]
        assert newest["at"] == await browser.server.api._market.time_of(newest["block"])
        times = [one["at"] for one in history["jobs"]]
        assert times == sorted(times, reverse=True)
        assert (await browser.get("market/history", model=posted["order"]["objective"]))["jobs"] == []
        await browser.get("market/history", status=400, model="none")
    async with serve() as browser:  # which has no statement yet
        statement = await browser.get(f"accounts/{place.address('robot')}/statement")
        assert {one["liability"] for one in statement["contracts"]} >= set(addresses)
        last = statement["contracts"][-1]
        assert (last["liability"], last["earned"], last["promisee"]) == (address, str(COST), person)
        assert statement["sums"]
        url = f"{browser.server.url}/api/v1/accounts/{place.address('robot')}/statement"
        async with browser.session.get(url, params={"format": "csv"}) as response:
            assert response.content_type == "text/csv"
            assert "attachment" in response.headers["Content-Disposition"]
            rows = list(csv.DictReader(io.StringIO(await response.text())))
        assert [row["liability"] for row in rows] == [one["liability"] for one in statement["contracts"]]
        assert rows[-1]["symbol"] == last["symbol"]
        async with browser.session.get(url, params={"format": "pdf"}) as response:
            assert response.status == 400


async def test_one_person_does_not_keep_the_node_busy_with_statements(serve: Any) -> None:
    async with serve() as browser:
        accounts = f"{browser.server.url}/api/v1/accounts"
        asked = [browser.session.get(f"{accounts}/0x{number:040x}/statement") for number in range(40)]
        assert sum(one.status == 429 for one in await asyncio.gather(*asked)) >= 10


def test_times_between_blocks_are_estimated() -> None:
    times = [(10, 100.0), (20, 300.0), (21, 301.0)]
    found = [time_between(times, block) for block in (9, 10, 15, 20, 21, 22)]
    assert found == [100.0, 100.0, 200.0, 300.0, 301.0, 301.0]
    assert time_between([], 1) is None

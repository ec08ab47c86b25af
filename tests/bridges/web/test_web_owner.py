"""The page's server: answers without a contract, refunds, logs, and recordings opened by another site."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mesh import Demand, String, Verified
from schemas import RpcKey
from tests.bridges.web.conftest import OWN
from tests.bridges.web.test_page_server import DATA, signed_demand
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.waiting import until_answered, until_found

if TYPE_CHECKING:
    from tests.support.market import Place

OPERATOR = "a token of operators 456"
FOXGLOVE = {"Origin": "https://app.foxglove.dev", "Sec-Fetch-Site": "cross-site"}


async def test_a_question_gets_its_answer_without_a_contract(place: Place, serve: Any) -> None:
    robot = place.agent("robot")

    @robot.on_demand
    async def measure(demand: Verified[Demand]) -> None:
        await robot.answer(demand, String("21 °C"), topic="/temperature")

    person = place.market.accounts["person"]
    async with robot, serve() as browser:
        posted = await browser.post("orders", await signed_demand(browser, person, MODEL, cost=0), status=202)
        assert posted["answers"] == []

        async def answered() -> Any:
            return (await browser.get(f"orders/{posted['order']['hash']}"))["answers"]

        await until_found(answered, what="an answer")
        (found,) = await answered()
        assert found["signer"] == place.address("robot")
        assert found["liability"] == person.address
        summary = await browser.get(f"files/{found['result']}/summary")
        assert summary["metadata"]["aira-answer"]["demand"] == posted["order"]["hash"]


async def test_a_job_that_may_still_be_done_is_not_refunded(place: Place, serve: Any) -> None:
    async with place.provider(), offering(place.agent("robot")), serve("person") as browser:
        made = await browser.post("objectives", objective(("/blink", "on")), headers=DATA)
        wanted = {"model": MODEL, "objective": made["cid"], "cost": "0"}
        posted = await browser.post("local/orders", wanted, status=202)

        async def matched() -> Any:
            return (await browser.get(f"orders/{posted['order']['hash']}"))["liability"]

        await until_found(matched, what="a contract")
        job = {"liability": await matched()}
        assert (await browser.post("local/refunds", job, status=502))["error"]["code"] == "not-refundable"
        async with serve() as other:
            assert (await other.post("local/refunds", job, status=409))["error"]["code"] == "no-local-account"


async def test_logs_are_read_by_operators_where_people_log_in(place: Place, serve: Any) -> None:
    async with place.agent("robot", open_services=True), serve() as browser:
        robot = place.address("robot")
        await until_answered(browser.server.components.network.session, str(RpcKey(robot, "logs")))
        assert (await browser.get(f"agents/{robot}/logs", level="loud", status=400))["error"]["code"] == (
            "invalid-request"
        )
        # An agent inside another program keeps no log: it was asked, and said so.
        assert (await browser.get(f"agents/{robot}/logs", status=502))["error"]["code"] == "service-failed"
    async with place.agent("robot", open_services=True), serve(operator_token=OPERATOR) as browser:
        assert (await browser.get(f"agents/{robot}/logs", status=403))["error"]["code"] == "operators-only"
        session = f"{browser.server.url}/api/v1/session"
        async with browser.session.post(session, json={"token": OPERATOR}, headers=OWN) as response:
            headers = {"Cookie": response.headers["Set-Cookie"].partition(";")[0]}
        await until_answered(browser.server.components.network.session, str(RpcKey(robot, "logs")))
        async with browser.session.get(f"{browser.server.url}/api/v1/agents/{robot}/logs", headers=headers) as response:
            assert (await response.json())["error"]["code"] == "service-failed"


async def test_foxglove_reads_recordings_in_parts_and_nothing_else(serve: Any) -> None:
    async with serve() as browser:
        made = await browser.post("objectives", objective(("/blink", "on")), headers=DATA)
        file = f"{browser.server.url}/api/v1/files/{made['cid']}/recording.mcap"
        async with browser.session.options(file, headers=FOXGLOVE) as response:
            assert response.status == 204
            assert response.headers["Access-Control-Allow-Headers"] == "Range"
        async with browser.session.get(file, headers=FOXGLOVE | {"Range": "bytes=0-7"}) as response:
            assert response.status == 206
            assert response.headers["Access-Control-Allow-Origin"] == FOXGLOVE["Origin"]
            assert (await response.read()).startswith(b"\x89MCAP")
        for path, headers in (
            (f"files/{made['cid']}/summary", FOXGLOVE),
            (f"files/{made['cid']}/recording.mcap", FOXGLOVE | {"Origin": "https://evil.example"}),
        ):
            async with browser.session.get(f"{browser.server.url}/api/v1/{path}", headers=headers) as response:
                assert response.status == 403
                assert "Access-Control-Allow-Origin" not in response.headers
    async with serve(token="a token of people 123") as browser:
        file = f"{browser.server.url}/api/v1/files/{made['cid']}/recording.mcap"
        async with browser.session.get(file, headers=FOXGLOVE) as response:
            assert response.status == 401

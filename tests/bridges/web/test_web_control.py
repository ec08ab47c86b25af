"""The page of a robot's owner: operators change its price, pause it, stop it and release it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from schemas import RpcKey
from tests.bridges.web.conftest import OWN
from tests.support.market import Place, offering
from tests.support.waiting import until_answered

if TYPE_CHECKING:
    from tests.bridges.web.conftest import Browser

OPERATOR = "a token of operators 456"


async def log_in(browser: Browser) -> None:
    """Let this browser be an operator's."""
    async with browser.session.post(
        f"{browser.server.url}/api/v1/session", json={"token": OPERATOR}, headers=OWN
    ) as said:
        browser.session.headers["Cookie"] = said.headers["Set-Cookie"].partition(";")[0]


async def test_an_operator_controls_a_robot_of_the_servers_own_data_folder(place: Place, serve: Any) -> None:
    folder = {"data_dir": place.settings("robot").data_dir}
    async with offering(place.agent("robot")) as robot, serve(settings=folder, operator_token=OPERATOR) as browser:
        page = f"agents/{robot.address}"
        for path in ("settings", "stop", "release"):
            assert (await browser.post(f"{page}/{path}", {}, status=403))["error"]["code"] == "operators-only"
        assert (await browser.get(f"{page}/settings", status=403))["error"]["code"] == "operators-only"
        await log_in(browser)
        before = await browser.get(f"{page}/settings")
        assert before == {
            "price": "", "paused": False, "refuse": [], "leastPrice": "", "held": False, "stopped": "", "here": True,
            "events": [], "notify": []
        }  # fmt: skip
        wanted = {"price": "6 XRT", "paused": True, "refuse": [place.address("person")], "leastPrice": "1.5 XRT"}
        assert await browser.post(f"{page}/settings", wanted) == before | wanted
        assert (await robot.control()).price == "6 XRT"
        wrong = await browser.post(f"{page}/settings", {"price": "a lot"}, status=400)
        assert wrong["error"]["code"] == "invalid-amount"
        await browser.post(f"{page}/settings", {"pause": True}, status=400)
        stopped = await browser.post(f"{page}/stop", {"why": "smoke"})
        assert (stopped["held"], stopped["stopped"]) == (True, "stopped 0 jobs")
        assert (await robot.runtime.profile.present()).state == "stopped"
        assert not (await browser.post(f"{page}/release", {}))["held"]


async def test_a_robot_elsewhere_is_controlled_by_its_service_if_its_owner_opened_it(place: Place, serve: Any) -> None:
    for is_open in (True, False):
        async with offering(place.agent("robot", open_services=is_open)) as robot, serve("person") as browser:
            await until_answered(browser.server.components.network.session, str(RpcKey(robot.address, "status")))
            path = f"agents/{robot.address}/settings"
            assert (await browser.get("market"))["role"] == "operator", "who may spend the account's money"
            if is_open:
                changed = await browser.post(path, {"paused": True})
                assert (changed["paused"], changed["here"]) == (True, False)
            else:
                assert (await browser.post(path, {"paused": False}, status=502))["error"]["code"] == "service-failed"
                assert (await robot.control()).paused

"""The page's server and the robots: how they present themselves, what they ask, and orders for one of them alone."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

from mesh import Demand, Verified  # noqa: TC001  handlers are read at run time
from mesh.agent.errors import Declined
from tests.bridges.web.test_page_server import DATA
from tests.mesh.agent.test_hiring import another, listening
from tests.mesh.agent.test_quotes import priced
from tests.mesh.agent.trades import working
from tests.support.market import MODEL
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from tests.support.market import Place

NAMED = {"name": "Arm", "about": "It moves.", "place": "Hall 3"}


async def made(browser: Any) -> str:
    return str((await browser.post("objectives", objective(("/go", "there")), headers=DATA))["cid"])


async def contract_of(browser: Any, order_hash: str) -> str:
    async def matched() -> Any:
        return (await browser.get(f"orders/{order_hash}"))["liability"]

    return str(await until_found(matched, what="a contract"))


async def test_robots_present_themselves_and_say_what_they_want(place: Place, serve: Any) -> None:
    cheap = priced(place.agent("robot", **NAMED), 4)
    async with another(place) as declining, cheap, priced(declining, 1, only="closed-today"), serve() as browser:

        async def presented() -> Any:
            agents = (await browser.get("agents"))["agents"]
            return {one["address"]: one for one in agents if one["profile"]} if len(agents) == 2 else None

        agents = await until_found(presented, what="two robots")
        arm = agents[cheap.address]
        assert [arm["profile"][name] for name in ("name", "about", "place", "state")] == [
            "Arm",
            "It moves.",
            "Hall 3",
            "idle",
        ]
        assert arm["models"] == [MODEL]
        asked = {"model": MODEL, "objective": await made(browser)}
        quotes = (await browser.post("quotes", asked))["quotes"]
        assert [(one["agent"], one["name"], one["cost"], one["code"]) for one in quotes] == [
            (cheap.address, "Arm", "4", ""),
            (declining.address, "", "0", "closed-today"),
        ]
        assert quotes[0]["token"] == (await browser.get("market"))["xrt"]
        assert quotes[1]["detail"] == "not today"
        assert quotes[0]["until"] > 0
        await browser.post("quotes", {"model": "no CID", "objective": "neither"}, status=400)


async def test_an_order_for_one_robot_is_seen_by_nobody_else(place: Place, serve: Any) -> None:
    robot, rival = place.agent("robot"), another(place)
    async with (
        place.provider(),
        working(robot),
        rival as other,
        working(other),
        serve("person") as browser,
        listening(place) as heard,
        browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket,
    ):
        await socket.send_json({"subscribe": ["market"], "after": 0, "stream": browser.server.api.stream.id})
        for _ in range(2):
            wanted = {"model": MODEL, "objective": await made(browser), "cost": "7", "robot": robot.address}
            posted = (await browser.post("local/orders", wanted, status=202))["order"]
            assert (posted["private"], posted["signature"], posted["robot"]) == (True, "", robot.address)
            assert (await browser.get("orders"))["orders"] == []
            job = await browser.get(f"liabilities/{await contract_of(browser, posted['hash'])}")
            assert job["liability"]["promisor"] == robot.address
        assert heard == []
        kinds = set[str]()
        async with asyncio.timeout(30):
            while "matched" not in kinds:
                kinds |= {event["kind"] for event in json.loads((await socket.receive()).data)}
        assert "order" not in kinds


async def test_a_robot_that_declines_an_order_for_it_alone_says_why(place: Place, serve: Any) -> None:
    robot = place.agent("robot")

    @robot.on_demand
    async def price(demand: Verified[Demand]) -> None:
        raise Declined("too-cheap", "50 wn at least")

    async with robot, serve("person") as browser:
        wanted = {"model": MODEL, "objective": await made(browser), "cost": "7", "robot": robot.address}
        refused = await browser.post("local/orders", wanted, status=502)
        assert refused["error"]["code"] == "demand-declined"
        assert "50 wn at least" in refused["error"]["message"]
        await browser.post("local/orders", wanted | {"robot": "nobody"}, status=400)


async def test_an_order_for_one_robot_is_known_after_a_restart(place: Place, serve: Any) -> None:
    async with working(place.agent("robot")) as robot, serve("person") as browser:  # no provider
        wanted = {"model": MODEL, "objective": await made(browser), "cost": "7", "robot": robot.address}
        posted = await browser.post("local/orders", wanted, status=202)
    async with serve("person") as browser:
        known = await browser.get(f"orders/{posted['order']['hash']}")
        assert (known["order"]["private"], known["order"]["robot"], known["state"]) == (
            True,
            place.address("robot"),
            "open",
        )
        assert (await browser.get("orders"))["orders"] == []
        order = {"order": posted["order"]["hash"]}
        assert (await browser.post("local/withdrawals", order))["state"] == "withdrawn"

"""The page's server and the robots: how they present themselves, what they ask, and orders for one of them alone."""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import pytest_asyncio
from msgspec.structs import replace

from bridges.web import _views
from mesh import Agent, Demand, Verified
from mesh.agent.handlers import Declined
from mesh.chain import Account
from mesh.role.handover import keep_handover
from mesh.testing import MarketChain
from schemas import ZERO_ADDRESS, message_hash
from schemas.profiles import Handover
from schemas.rpc import AcceptDemand, OrderPair, SendDemand, SendOffer
from tests.bridges.web.test_page_server import DATA
from tests.mesh.agent.test_hiring import listening
from tests.mesh.agent.test_quotes import priced
from tests.support.agent.trades import working
from tests.support.market import MODEL
from tests.support.objectives import objective
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import pytest

    from tests.support.market import Place

NAMED = {"name": "Arm", "about": "It moves.", "place": "Hall 3"}


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def market_chain() -> AsyncIterator[MarketChain]:
    """One without the robots of other tests, which are away."""
    async with MarketChain() as chain:
        yield chain


async def made(browser: Any) -> str:
    return str((await browser.post("objectives", objective(("/go", "there")), headers=DATA))["cid"])


async def contract_of(browser: Any, order_hash: str) -> str:
    async def matched() -> Any:
        return (await browser.get(f"orders/{order_hash}"))["liability"]

    return str(await until_found(matched, what="a contract"))


async def kinds_until_matched(socket: Any) -> set[str]:
    """The kinds of the market's events, up to that of a contract."""
    kinds = set[str]()
    async with asyncio.timeout(30):
        while "matched" not in kinds:
            kinds |= {event["kind"] for event in json.loads((await socket.receive()).data)}
    return kinds


async def test_robots_present_themselves_and_say_what_they_want(place: Place, serve: Any) -> None:
    cheap = priced(place.agent("robot", **NAMED), 4)
    async with place.another(5) as declining, cheap, priced(declining, 1, only="closed-today"), serve() as browser:

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


@asynccontextmanager
async def moved(place: Place) -> AsyncIterator[Agent]:
    """The robot at work with a key that took over."""
    account, settings = Account(secrets.token_bytes(32)), place.settings("moved", **NAMED)
    handover = Handover(agent=place.address("robot"), successor=account.address, time=1)
    keep_handover(settings.state_directory, handover.signed_by(place.market.accounts["robot"].signer))
    async with (
        place.chain_of(account, place.generation) as chain,
        working(Agent(MODEL, settings=settings, account=account, chain=chain)) as successor,
    ):
        yield successor


async def test_robots_that_have_left_are_known_as_away(
    place: Place, serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = place.agent("robot", **NAMED)
    async with place.provider(), serve("person") as browser:

        async def agents() -> Any:
            return await browser.get("agents")

        async def named() -> Any:
            return [one for one in (await agents())["agents"] if one["profile"]]

        before = time.time()
        async with working(robot):
            (here,) = await until_found(named, what="the robot")
            wanted = {"model": MODEL, "objective": await made(browser), "cost": "7", "robot": robot.address}
            posted = (await browser.post("local/orders", wanted, status=202))["order"]
            job = await contract_of(browser, posted["hash"])

            async def paid() -> Any:
                return (await browser.get(f"liabilities/{job}"))["liability"]["state"] == "paid"

            await until_found(paid, what="the payment")
            assert (await agents())["away"] == []

        async def gone() -> Any:
            return (await agents())["away"]

        (away,) = await until_found(gone, what="that the robot is away")
        assert (away["address"], away["profile"]["name"], away["models"]) == (place.address("robot"), "Arm", [MODEL])
        assert before <= away["since"] <= time.time()
        done = here["record"]["done"] + 1  # other tests share the chain
        assert away["record"]["done"] == done
        async with serve() as later:  # it has never seen the robot, but its contract

            async def known() -> Any:
                return (await later.get("agents"))["away"]

            (away,) = await until_found(known, what="the robot of the contract")
            assert (away["address"], away["profile"], away["record"]["done"]) == (place.address("robot"), None, done)
            async with moved(place) as successor:

                async def come() -> Any:
                    await asyncio.sleep(0.5)  # the server answers as it did for some seconds, and only so many requests
                    return [one for one in (await later.get("agents"))["agents"] if one["profile"]]

                (here,) = await until_found(come, what="the robot with its new key")
                assert (here["address"], here["profile"]["formerly"]) == (successor.address, [place.address("robot")])
                assert here["record"]["done"] == done
                assert await known() == []
            monkeypatch.setattr(_views, "AWAY_LIMITS", _views.AWAY_LIMITS._replace(seconds=-3600.0))
            monkeypatch.setattr(later.server.api._views, "_agents", None)
            assert await known() == []


async def test_an_order_for_one_robot_is_seen_by_nobody_else(place: Place, serve: Any) -> None:
    robot, rival = place.agent("robot"), place.another(5)
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
        assert "order" not in await kinds_until_matched(socket)


async def demand_of(browser: Any, cost: int) -> Demand:
    """An unsigned demand, as the page makes it."""
    market = await browser.get("market")
    return Demand(
        model=MODEL,
        objective=await made(browser),
        token=market["token"]["address"],
        cost=cost,
        lighthouse=market["lighthouse"]["address"],
        validator=ZERO_ADDRESS,
        validator_fee=0,
        deadline=market["block"] + 200,
        nonce=secrets.token_hex(32),
    )


async def test_a_wallet_orders_from_one_robot_alone(place: Place, serve: Any) -> None:
    signer, chain = place.market.accounts["person"].signer, place.chains["person"]
    async with (
        place.provider(),
        working(place.agent("robot")) as robot,
        place.another(5) as rival,
        working(rival),
        serve() as browser,
        listening(place) as heard,
        browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket,
    ):
        await socket.send_json({"subscribe": ["market"], "after": 0, "stream": browser.server.api.stream.id})
        demand = await demand_of(browser, cost=9)
        await chain.tokens.approve(chain.factory, 9)
        asked = AcceptDemand(demand=SendDemand.of(demand), robot=robot.address, maker=signer.address)
        await browser.post("pairs/offers", asked.encode(), status=400)  # nobody has signed it
        whole = AcceptDemand(demand=SendDemand.of(signer.sign(demand)), robot=robot.address, maker=signer.address)
        await browser.post("pairs/offers", whole.signed_by(signer).encode(), status=400)  # the robot could use it
        accepted = await browser.post("pairs/offers", asked.signed_by(signer).encode())
        offer = SendOffer.decode(msgspec.json.encode(accepted["offer"]))
        pair = OrderPair(demand=SendDemand.of(signer.sign(demand)), offer=offer, maker=signer.address)
        await browser.post("pairs", pair.encode(), status=400)
        stranger = place.market.accounts["provider"].signer
        await browser.post("pairs", replace(pair, maker=stranger.address).signed_by(stranger).encode(), status=400)
        other = SendDemand.of(signer.sign(replace(demand, cost=8)))
        await browser.post("pairs", replace(pair, demand=other).signed_by(signer).encode(), status=400)
        signed = pair.signed_by(signer).encode()
        posted, again = [await browser.post("pairs", signed, status=202) for _ in range(2)]
        assert posted["order"] == again["order"]
        order = posted["order"]
        assert (order["private"], order["signature"], order["robot"]) == (True, "", robot.address)
        assert order["hash"] == message_hash(demand).hex()
        assert (await browser.get("orders"))["orders"] == []
        job = await browser.get(f"liabilities/{await contract_of(browser, order['hash'])}")
        assert (job["liability"]["promisor"], job["private"]) == (robot.address, True)
        assert heard == []
        assert "order" not in await kinds_until_matched(socket)
        await browser.post(
            "pairs", replace(pair, offer=replace(offer, signature="")).signed_by(signer).encode(), status=400
        )


async def test_a_pair_is_sent_until_a_provider_takes_it(place: Place, serve: Any) -> None:
    signer, chain = place.market.accounts["person"].signer, place.chains["person"]
    async with working(place.agent("robot")) as robot, serve() as browser:
        demand = await demand_of(browser, cost=9)
        await chain.tokens.approve(chain.factory, 9)
        asked = AcceptDemand(demand=SendDemand.of(demand), robot=robot.address, maker=signer.address)
        accepted = await browser.post("pairs/offers", asked.signed_by(signer).encode())
        offer = SendOffer.decode(msgspec.json.encode(accepted["offer"]))
        pair = OrderPair(demand=SendDemand.of(signer.sign(demand)), offer=offer, maker=signer.address)
        posted = await browser.post("pairs", pair.signed_by(signer).encode(), status=202)

        async def said() -> Any:
            return (await browser.get(f"orders/{posted['order']['hash']}"))["statements"]

        (statement,) = await until_found(said, what="that no provider answers")
        assert (statement["kind"], statement["code"]) == ("rejected", "no-answer")
        async with place.provider():
            job = await browser.get(f"liabilities/{await contract_of(browser, posted['order']['hash'])}")
            assert job["liability"]["promisor"] == robot.address


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
        signer = place.market.accounts["person"].signer
        demand = SendDemand.of(await demand_of(browser, cost=7))
        asked = AcceptDemand(demand=demand, robot=robot.address, maker=signer.address)
        accepted = await browser.post("pairs/offers", asked.signed_by(signer).encode())
        assert (accepted["decline"]["code"], accepted["decline"]["detail"]) == ("too-cheap", "50 wn at least")


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

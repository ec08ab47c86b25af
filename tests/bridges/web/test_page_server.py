"""The page's server: a whole job through its interface, at a real market."""

from __future__ import annotations

import asyncio
import json
import secrets
from typing import TYPE_CHECKING, Any

from mesh import Job, String  # noqa: TC001  handlers are read at run time
from schemas import ZERO_ADDRESS, Demand, Result, Withdrawal, cid_of_bytes, encode
from schemas.keys import event_selector
from schemas.model import ModelDescription, ModelTopic, ValueSchema
from tests.mesh.validator.test_legacy import DUE, bag, below
from tests.support.market import MODEL, offering, offering_unseen
from tests.support.objectives import objective
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.chain import Account
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

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


async def test_the_result_of_a_legacy_robot_is_verified_as_by_the_command(
    place: Place, serve: Any, tmp_path: Path
) -> None:
    """Such a robot hands in a bag with all topics below its contract's address."""
    robot = offering_unseen(place.agent("robot", enable_executor=False))
    async with place.provider(), robot, serve("person") as browser:
        cid = await robot.add(bag(tmp_path / "objective.bag", DUE))
        posted = await browser.post("local/orders", {"model": MODEL, "objective": cid, "cost": str(COST)}, status=202)

        async def matched() -> Any:
            return (await browser.get(f"orders/{posted['order']['hash']}"))["liability"]

        address = await until_found(matched, what="a contract")
        result = await robot.add(bag(tmp_path / "result.bag", below(DUE, address)))
        await robot.parts.outbox.post(robot.parts.signer.sign(Result(liability=address, result=result, success=True)))

        async def verified() -> Any:
            state = (await browser.get(f"liabilities/{address}"))["liability"]["state"]
            return await browser.get(f"liabilities/{address}/verification") if state == "paid" else None

        verdict = await until_found(verified, what="a payment")
        assert verdict["holds"], verdict
        assert {"name": "played", "holds": True} in [
            {"name": one["name"], "holds": one["holds"]} for one in verdict["findings"]
        ]


async def test_a_page_that_comes_late_shows_how_far_a_job_is(place: Place, serve: Any) -> None:
    robot, may_end = offering(place.agent("robot")), asyncio.Event()
    told: list[bytes] = []

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        if message.data == "off":
            await may_end.wait()

    source = place.save(objective(("/blink", "on"), ("/blink", "off")))
    async with place.at_work(robot) as person:
        heard: Any = person.network.session.declare_subscriber(
            event_selector(place.address("robot")), lambda sample: told.append(sample.payload.to_bytes())
        )
        contract = await person.demand(source, cost=COST)
        await until(lambda: b'{"position":1,"total":2}' in told, what="the position")
        heard.undeclare()
        async with serve() as browser:

            async def running() -> bool:
                return bool((await browser.get(f"liabilities/{contract.address}"))["phase"] == "running")

            await until_found(running, what="the phase")
            job = await browser.get(f"liabilities/{contract.address}")
            assert [step["kind"] for step in job["timeline"]] == ["created", "ready", "playing"]
            assert job["playback"] == {"position": 1, "total": 2}
            may_end.set()
            assert (await contract.outcome()).success


DATA = {"X-Aira-Request": "1", "Content-Type": "application/octet-stream"}


async def test_the_stream_tells_each_step_of_a_job(place: Place, serve: Any) -> None:
    robot = offering(place.agent("robot"))

    @robot.on("/blink")
    async def blink(job: Job, message: String) -> None:
        pass

    async with place.provider(), robot, serve("person") as browser:
        made = await browser.post("objectives", objective(("/blink", "on")), headers=DATA)
        assert (await browser.get("market"))["account"] == place.address("person")
        wanted = {"model": MODEL, "objective": made["cid"], "cost": str(COST)}
        async with browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": ["market"]})
            await socket.receive()  # it is subscribed
            posted = await browser.post("local/orders", wanted, status=202)
            assert posted["order"]["signer"] == place.address("person")
            kinds: list[str] = []
            async with asyncio.timeout(120):
                while "matched" not in kinds:
                    for event in json.loads((await socket.receive()).data):
                        kinds.append(event["kind"])
                        if event["kind"] == "matched":
                            address = event["data"]["liability"]["address"]
                from_the_start = {"after": 0, "stream": browser.server.api.stream.id}
                await socket.send_json({"subscribe": [f"liability/{address}"]} | from_the_start)
                while "paid" not in kinds:
                    kinds += [event["kind"] for event in json.loads((await socket.receive()).data)]
        assert kinds.index("order") < kinds.index("matched") < kinds.index("paid")

        async def answering() -> list[Any]:
            agents = (await browser.get("agents"))["agents"]
            return [one for one in agents if one["address"] == place.address("robot") and one["health"] == "alive"]

        (about,) = await until_found(answering, what="the robot's answer")
        assert about["models"] == [MODEL]
        assert about["record"]["done"] >= 1
        jobs = await browser.get("liabilities", party=place.address("person"), limit=1)
        assert jobs["liabilities"][0]["address"] == address
        assert jobs["liabilities"][0]["token"]["symbol"] == "XRT"
        account = await browser.get(f"accounts/{place.address('person')}")
        assert int(account["spent"]) >= COST
        provider = (await browser.get("lighthouse"))["providers"][0]
        assert (provider["address"], provider["hasTurn"]) == (place.address("provider"), True)


async def test_an_open_order_is_withdrawn_by_its_signer_alone(place: Place, serve: Any) -> None:
    person, stranger = place.market.accounts["person"], place.market.accounts["robot"]
    async with place.provider(), serve() as browser:
        posted = await browser.post("orders", await signed_demand(browser, person, MODEL, cost=0), status=202)
        order = posted["order"]
        terms = {"order": order["hash"], "lighthouse": order["lighthouse"], "deadline": order["deadline"]}
        forged = encode(stranger.signer.sign(Withdrawal(**terms)))
        assert (await browser.post("orders", forged, status=404))["error"]["code"] == "page-not-found"
        assert (await browser.get(f"orders/{order['hash']}"))["state"] == "open"
        withdrawn = await browser.post("orders", encode(person.signer.sign(Withdrawal(**terms))), status=202)
        assert withdrawn["state"] == "withdrawn"

        async def honoured() -> bool:
            statements = (await browser.get(f"orders/{order['hash']}"))["statements"]
            return any(
                said["code"] == "withdrawn" and said["agent"] == place.address("provider") for said in statements
            )

        await until_found(honoured, what="the provider's word")


async def test_the_local_account_withdraws_its_order(place: Place, serve: Any) -> None:
    async with place.provider(), serve("person") as browser:
        wanted = {"model": MODEL, "objective": MODEL, "cost": "0"}
        order_hash = (await browser.post("local/orders", wanted, status=202))["order"]["hash"]
        withdrawn = await browser.post("local/withdrawals", {"order": order_hash})
        assert withdrawn["state"] == "withdrawn"
    async with serve() as browser:
        refused = await browser.post("local/orders", wanted, status=409)
        assert refused["error"]["code"] == "no-local-account"


async def test_an_order_that_no_provider_could_use_is_refused_with_the_reason(place: Place, serve: Any) -> None:
    poor, person = place.market.accounts["robot"], place.market.accounts["person"]
    async with place.provider(), serve() as browser:
        demand = await signed_demand(browser, poor, MODEL, cost=10**30)
        refused = (await browser.post("orders", demand, status=400))["error"]
        assert refused["code"] == "order-unusable"
        assert refused["reason"].startswith("ERC20Insufficient")
        late = await signed_demand(browser, person, MODEL, cost=0, lifetime=10**6)
        assert (await browser.post("orders", late, status=400))["error"]["reason"] == "deadline"
        past = await signed_demand(browser, person, MODEL, cost=0, lifetime=0)
        assert (await browser.post("orders", past, status=400))["error"]["reason"] == "expired"


async def test_the_default_lifetime_is_one_that_is_accepted(place: Place, serve: Any) -> None:
    async with place.provider(), serve(settings={"deadline_limit": 40}) as browser:
        market = await browser.get("market")
        assert (market["defaultLifetime"], market["limits"]["lifetime"]) == (40, 40)
        demand = await signed_demand(browser, place.market.accounts["person"], MODEL, cost=0, lifetime=40)
        await browser.post("orders", demand, status=202)


async def test_posting_again_changes_nothing(place: Place, serve: Any) -> None:
    async with place.provider(), serve() as browser:
        demand = await signed_demand(browser, place.market.accounts["person"], MODEL, cost=0)
        first = await browser.post("orders", demand, status=202)
        assert (await browser.post("orders", demand, status=202))["order"] == first["order"]
    async with place.provider(), serve() as browser:  # another server, which knows nothing
        assert (await browser.post("orders", demand, status=202))["order"]["hash"] == first["order"]["hash"]


async def test_a_form_becomes_an_objective_that_its_model_accepts(serve: Any) -> None:
    colour = ModelTopic(topic="/colour", value=ValueSchema(type="string", enum=("red", "blue")), required=True)
    model = ModelDescription(title="A lamp", objective=(colour, ModelTopic(topic="/go")))
    async with serve() as browser:
        cid = (await browser.post("objectives", model.encode(), headers=DATA))["cid"]
        described = await browser.get(f"models/{cid}")
        assert described["description"]["title"] == "A lamp"
        values = [{"topic": "/colour", "value": "red"}, {"topic": "/go", "value": None, "at": 1.5}]
        made = await browser.post("objectives/form", {"model": cid, "values": values})
        assert made["preflight"]["ok"]
        assert made["summary"]["durationNs"] == str(1_500_000_000)
        wrong = await browser.post("objectives/form", {"model": cid, "values": [{"topic": "/colour", "value": "puce"}]})
        assert wrong["preflight"]["reason"] == "unfit-message"
        assert await browser.get(f"files/{wrong['cid']}/preflight", model=cid) == wrong["preflight"]


async def test_a_model_that_nobody_has_is_soon_reported_and_can_be_ordered(serve: Any) -> None:
    unknown = cid_of_bytes(b"nobody has this")
    async with asyncio.timeout(60), serve() as browser:
        refused = await browser.get(f"models/{unknown}", status=404)
        assert refused["error"]["code"] == "content-unavailable"
        made = await browser.post(f"objectives?model={unknown}", objective(("/go", "on")), headers=DATA)
        assert made["preflight"]["ok"]


async def test_a_recording_is_listed_and_plotted(serve: Any) -> None:
    moves = [("/move", {"linear": {"x": number / 2}, "name": "a"}) for number in range(9_000)]
    async with serve() as browser:
        cid = (await browser.post("objectives", objective(("/go", "1.5"), *moves), headers=DATA))["cid"]
        topics = {topic["topic"]: topic for topic in (await browser.get(f"files/{cid}/summary"))["topics"]}
        assert topics["/move"]["messages"] == 9_000
        assert topics["/move"]["shown"] == "values"
        page = await browser.get(f"files/{cid}/messages", topic="/move", limit=2)
        assert [message["number"] for message in page["messages"]] == [1, 2]
        assert page["next"] == 2
        plotted = await browser.get(f"files/{cid}/values", topic="/move")
        assert plotted["messages"] == 9_000
        assert plotted["points"] == len(plotted["at"]) <= 4_000
        assert [column["name"] for column in plotted["columns"]] == ["linear.x"]
        assert plotted["columns"][0]["values"][1] == 1.5


async def test_what_a_reorganisation_reverts_is_open_again(place: Place, serve: Any) -> None:
    async with place.provider(), offering(place.agent("robot")), serve() as browser:
        made = await browser.post("objectives", objective(("/none", "on")), headers=DATA)
        before = await place.chains["provider"].block_number()
        demand = await signed_demand(browser, place.market.accounts["person"], made["cid"], cost=0)
        order_hash = (await browser.post("orders", demand, status=202))["order"]["hash"]

        async def contract() -> Any:
            return (await browser.get(f"orders/{order_hash}"))["liability"]

        await until_found(contract, what="a contract")
        head = await place.chains["provider"].block_number()
        events: list[str] = []
        async with browser.session.ws_connect(f"{browser.server.url}/api/v1/stream") as socket:
            await socket.send_json({"subscribe": [f"order/{order_hash}"]})
            await socket.receive()  # it is subscribed
            await place.forget_blocks(head - before)
            async with asyncio.timeout(60):
                while "open" not in events or "contract" not in events[events.index("open") :]:
                    events += [event["kind"] for event in json.loads((await socket.receive()).data)]


async def test_the_page_goes_on_after_its_router_was_away(place: Place, router: EmbeddedRouter, serve: Any) -> None:
    async with place.provider(), offering(place.agent("robot")), serve() as browser:
        router.stop()

        async def is_connected() -> bool:
            return bool((await browser.get("market"))["connected"]["router"])

        async def is_alone() -> bool:
            return not await is_connected()

        await until_found(is_alone, what="the loss of the router")
        assert (await browser.get("agents"))["agents"] == []
        made = await browser.post("objectives", objective(("/none", "on")), headers=DATA)
        demand = await signed_demand(browser, place.market.accounts["person"], made["cid"], cost=0)
        order_hash = (await browser.post("orders", demand, status=202))["order"]["hash"]
        router.start()
        await until_found(is_connected, what="the router")

        async def matched() -> Any:
            return (await browser.get(f"orders/{order_hash}"))["liability"]

        await until_found(matched, what="a contract")

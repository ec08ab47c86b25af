"""The agent as its user sees it: when it runs, what its handlers hear, how it ends."""

from __future__ import annotations

import asyncio
import logging
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.agent import Phase
from mesh.chain import JsonRpcServer, WrongPassword, write_keyfile
from mesh.errors import ClosedError, ConfigurationError, NetworkUnavailable
from mesh.network import Channel, Endpoints, Network, free_endpoint
from schemas import Demand, Offer, Result, Verified, cid_of_bytes
from tests.support.market import MODEL, obliging
from tests.support.objectives import objective
from tests.support.orders import LIGHTHOUSE, MARKET, demand, offer, result, verified_demand
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.work.run import Run
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

Order = Verified[Demand] | Verified[Offer]
SOON = 0.02


@pytest.fixture
def settings(router: EmbeddedRouter) -> Settings:
    """Settings of an agent that only watches."""
    return Settings(connect=(router.endpoint,), lighthouse_contract=MARKET)


@pytest.fixture
async def channel(router: EmbeddedRouter) -> AsyncIterator[Channel]:
    """The market's channel, of somebody else."""
    async with (
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, MARKET, address=LIGHTHOUSE) as channel,
    ):
        yield channel


async def heard_on(channel: Channel, kind: str) -> None:
    """Wait until somebody listens to a kind of message."""
    await until_heard(channel._session, f"aira/{MARKET}/{kind}/{MODEL}/x")


async def test_an_agent_without_account_hears_the_market(settings: Settings, channel: Channel) -> None:
    agent = Agent(settings=settings)
    heard: list[object] = []

    @agent.on_demand
    async def on_demand(message: Verified[Demand]) -> None:
        heard.append(message.message)

    @agent.on_offer
    async def on_offer(message: Verified[Offer]) -> None:
        heard.append(message.message)

    @agent.on_result
    async def on_result(message: Verified[Result]) -> None:
        heard.append(message.message)

    async with agent:
        for kind in ("demand", "offer", "result"):
            await heard_on(channel, kind)
        messages: list[Demand | Offer | Result] = [demand(), offer(), result()]
        for message in messages:
            channel.publish(message)
        await until(lambda: len(heard) == 3)
        assert sorted(map(repr, heard)) == sorted(map(repr, messages))


async def test_an_agent_hears_the_orders_of_its_model_only(settings: Settings, channel: Channel) -> None:
    agent = Agent(MODEL, settings=settings)
    heard: list[Demand] = []

    @agent.on_demand
    async def on_demand(message: Verified[Demand]) -> None:
        heard.append(message.message)

    async with agent:
        await heard_on(channel, "demand")
        channel.publish(demand(model=cid_of_bytes(b"another")))
        ours = demand(model=MODEL)
        channel.publish(ours)
        await until(lambda: heard)
        assert heard == [ours]


async def test_all_handlers_of_a_kind_are_called_and_a_failing_one_stops_nothing(
    settings: Settings, channel: Channel, caplog: pytest.LogCaptureFixture
) -> None:
    agent = Agent(settings=settings)
    heard: list[Demand] = []

    @agent.on_demand
    async def crash(message: Verified[Demand]) -> None:
        raise ZeroDivisionError

    @agent.on_demand
    async def complain(message: Verified[Demand]) -> None:
        raise ConfigurationError("I have no account")

    @agent.on_demand
    async def be_cancelled(message: Verified[Demand]) -> None:
        inner = asyncio.create_task(asyncio.sleep(60))
        inner.cancel()
        await inner

    @agent.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.append(message.message)

    messages = [demand(), demand()]
    async with agent:
        await heard_on(channel, "demand")
        for message in messages:
            channel.publish(message)
        await until(lambda: len(heard) == 2)
    assert heard == messages
    assert caplog.text.count("handler crash failed; the agent goes on") == 2
    assert caplog.text.count("raise ZeroDivisionError") == 2, "with its traceback"
    (complaint, _) = [record for record in caplog.records if "I have no account" in record.message]
    assert complaint.levelno == logging.WARNING
    assert not complaint.exc_info
    assert caplog.text.count("handler be_cancelled ended with the cancellation") == 2


async def test_open_orders_are_heard_by_who_comes_late(place: Place) -> None:
    late = place.agent("robot")
    heard: list[Demand] = []

    @late.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.append(message.message)

    async with place.provider() as provider, place.agent("person") as person:
        asking = asyncio.create_task(person.demand(cid_of_bytes(b"a job"), cost=5))
        await until(lambda: len(provider.book) == 1)
        async with late:
            await until(lambda: heard)
        asking.cancel()
        await asyncio.wait([asking])
    assert heard[0].cost == 5


async def test_a_market_of_many_open_orders_is_heard_whole(place: Place) -> None:
    """More of them than what waits between Zenoh and the agent."""
    late = place.agent("robot", model="")
    heard: set[bytes] = set()

    @late.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.add(message.hash)

    deadline = await place.chains["provider"].block_number() + 10_000
    orders = [verified_demand(lighthouse=place.market.deployment.lighthouse, deadline=deadline) for _ in range(10_000)]
    async with place.provider() as provider:
        for order in orders:
            provider.book.add(order)
        async with late:
            await until(lambda: len(heard) == len(orders), seconds=30)


async def test_every_calls_at_the_start_and_again_and_bears_failures(settings: Settings) -> None:
    agent = Agent(settings=settings)
    calls = 0

    @agent.every(SOON)
    async def tick() -> None:
        nonlocal calls
        calls += 1
        raise ZeroDivisionError

    async with agent:
        await until(lambda: calls == 1, seconds=5)
        await until(lambda: calls >= 4, seconds=5)
    ended = calls
    await asyncio.sleep(3 * SOON)
    assert calls == ended


async def test_trading_without_account_is_one_clear_error(settings: Settings) -> None:
    async with Agent(settings=settings) as agent:
        for attempt in (
            agent.demand(cid_of_bytes(b"job")),
            agent.offer(objective=cid_of_bytes(b"job")),
            agent.contract(LIGHTHOUSE),
            agent.finish(LIGHTHOUSE, success=True),
        ):
            with pytest.raises(ConfigurationError, match="this agent has no account, it only watches") as caught:
                await attempt
            assert "keyfile" in caught.value.hint
        with pytest.raises(ConfigurationError):
            agent.address  # noqa: B018


async def test_an_agent_that_does_not_run_says_so(settings: Settings) -> None:
    agent = Agent(settings=settings)
    for use in ("channel", "parts", "address"):
        with pytest.raises(ClosedError, match="the agent is not running"):
            getattr(agent, use)
    async with agent:
        assert agent.channel.lighthouse == MARKET
    with pytest.raises(ClosedError):
        agent.channel  # noqa: B018


async def test_an_agent_runs_once_at_a_time_and_may_run_again(settings: Settings) -> None:
    agent = Agent(settings=settings)
    for _ in range(2):
        async with agent:
            with pytest.raises(ClosedError, match="running already"):
                await agent.__aenter__()
            assert agent.channel.lighthouse == MARKET


async def test_an_agent_that_could_not_start_may_be_started_later(router: EmbeddedRouter) -> None:
    await asyncio.to_thread(router.stop)
    agent = Agent(settings=Settings(connect=(router.endpoint,), connect_timeout=0.2))
    before = set(asyncio.all_tasks())
    with pytest.raises(NetworkUnavailable) as caught:
        await agent.__aenter__()
    assert "aira router" in caught.value.hint
    assert asyncio.all_tasks() == before
    await asyncio.to_thread(router.start)
    async with agent:
        assert await agent.channel.present() == []


async def test_leaving_ends_every_task_and_thread(place: Place) -> None:
    async with place.agent("person"):
        pass  # whatever Zenoh and asyncio keep for later is there now
    tasks = asyncio.all_tasks()
    threads = {thread for thread in threading.enumerate() if not thread.name.startswith("asyncio_")}
    robot = obliging(place.agent("robot"))

    @robot.every(SOON)
    async def tick() -> None:
        pass

    async with robot:
        assert asyncio.all_tasks() > tasks
    assert asyncio.all_tasks() == tasks

    def left() -> set[threading.Thread]:
        running = {thread for thread in threading.enumerate() if not thread.name.startswith("asyncio_")}
        return {thread for thread in running - threads if not thread.daemon}

    await until(lambda: not left())


async def test_leaving_cancels_a_handler_that_is_at_work(settings: Settings) -> None:
    agent = Agent(settings=settings)
    at_work, ended = asyncio.Event(), asyncio.Event()

    @agent.every(3600)
    async def work() -> None:
        try:
            at_work.set()
            await asyncio.Event().wait()
        finally:
            ended.set()

    async with agent:
        await at_work.wait()
    assert ended.is_set()


async def test_an_error_of_the_body_comes_out_as_it_is(settings: Settings) -> None:
    with pytest.raises(ZeroDivisionError):
        async with Agent(settings=settings):
            raise ZeroDivisionError


async def test_two_handlers_for_one_topic_are_refused() -> None:
    agent = Agent(settings=Settings())

    async def handler(job: Run, message: Any) -> None:
        pass

    agent.on("/go")(handler)
    with pytest.raises(ConfigurationError, match="two handlers for topic /go"):
        agent.on("/go")(handler)


async def test_agents_of_one_loop_are_independent(settings: Settings, channel: Channel) -> None:
    heard: dict[str, list[Demand]] = {"one": [], "two": []}
    agents = [listening(Agent(settings=settings), heard[name]) for name in heard]
    async with agents[0]:
        async with agents[1]:
            await heard_on(channel, "demand")
            channel.publish(demand())
            await until(lambda: all(heard.values()))
        channel.publish(demand())
        await until(lambda: len(heard["one"]) == 2)
    assert len(heard["two"]) == 1


def listening(agent: Agent, heard: list[Demand]) -> Agent:
    @agent.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.append(message.message)

    return agent


async def test_a_working_agent_shows_that_it_is_there(place: Place) -> None:
    async with place.agent("person") as person, place.agent("robot"):

        async def both() -> bool:
            present = {(key.role, key.agent) for key in await person.channel.present()}
            return present == {("agent", place.address(role).lower()) for role in ("robot", "person")}

        await until_found(both)


async def test_a_job_handler_that_uses_the_agent_while_it_ends_does_not_fail_its_job(place: Place) -> None:
    """A refund because of a Ctrl-C would be a job lost: it is to be resumed."""
    robot = obliging(place.agent("robot"))
    begun = asyncio.Event()

    @robot.on("/go")
    async def go(job: Run, message: Any) -> None:
        while True:
            begun.set()
            robot.channel.put(f"aira/agent/{robot.address.lower()}/device/arm/state", b"")
            await asyncio.sleep(0)

    async with place.provider(), place.agent("person") as person:
        async with robot:
            contract = await person.demand(place.save(objective(("/go", "x"))))
            await begun.wait()
        async with place.agent("robot", enable_executor=False) as observer:
            job = await observer.parts.ledger.job(contract.address)
            assert job is not None
            assert (job.phase, job.position) == (Phase.RUNNING, 0)


async def test_account_and_chain_come_from_the_settings(place: Place, tmp_path: Path) -> None:
    password = tmp_path / "password"
    await asyncio.to_thread(password.write_text, "open sesame\n")
    keyfile = tmp_path / "robot.json"
    key = place.node.funded_keys[1]
    address = await asyncio.to_thread(write_keyfile, keyfile, key, "open sesame")
    async with JsonRpcServer(place.node.provider) as server:
        settings = place.settings(
            "robot",
            web3_http_provider=server.url,
            keyfile=str(keyfile),
            keyfile_password_file=str(password),
        )
        async with Agent(MODEL, settings=settings) as robot:
            assert robot.address == address == place.address("robot")
            assert await robot.parts.chain.balance_of() == await place.balance("robot")
        await asyncio.to_thread(password.write_text, "open barley\n")
        with pytest.raises(WrongPassword):
            await Agent(MODEL, settings=settings).__aenter__()


async def test_a_lost_router_does_not_end_an_agent(settings: Settings, router: EmbeddedRouter) -> None:
    agent = Agent(settings=settings)
    heard: list[Demand] = []
    async with listening(agent, heard):
        await asyncio.to_thread(router.stop)
        await asyncio.to_thread(router.start)
        async with (
            Network(Endpoints(connect=(router.endpoint,))) as network,
            Channel(network.session, MARKET, address=LIGHTHOUSE) as channel,
        ):
            await heard_on(channel, "demand")
            channel.publish(demand())
            await until(lambda: heard)


async def test_no_router_is_told_with_its_endpoint() -> None:
    endpoint = free_endpoint()
    with pytest.raises(NetworkUnavailable, match=endpoint):
        async with Agent(settings=Settings(connect=(endpoint,), connect_timeout=0.1)):
            pass


def test_importing_agents_loads_no_chain() -> None:
    """An agent that watches needs none, and may live where web3 is not installed."""
    program = "import sys, mesh.agent; print([name for name in ('web3', 'eth_abi', 'aiohttp') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"

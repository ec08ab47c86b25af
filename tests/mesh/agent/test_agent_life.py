"""How an agent starts and ends, and which failures it survives."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.agent.ledger import Phase
from mesh.errors import ClosedError, NetworkUnavailable
from mesh.network import Endpoints, MarketRules, Network
from tests.support.agent.agents import SOON, OpenChannel, channel, heard_on, settings
from tests.support.market import offering
from tests.support.objectives import objective
from tests.support.orders import LIGHTHOUSE, MARKET, demand
from tests.support.ports import free_endpoint
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from mesh.agent.handlers import Job
    from schemas import Demand, Verified
    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

__all__ = ["channel", "settings"]


async def test_an_agent_that_is_not_running_raises(settings: Settings) -> None:
    agent = Agent(settings=settings)
    for use in ("channel", "parts", "address"):
        with pytest.raises(ClosedError):
            getattr(agent, use)
    async with agent:
        assert agent.channel.lighthouse == MARKET
    with pytest.raises(ClosedError):
        agent.channel  # noqa: B018


async def test_an_agent_runs_once_at_a_time_and_may_run_again(settings: Settings) -> None:
    agent = Agent(settings=settings)
    for _ in range(2):
        async with agent:
            with pytest.raises(ClosedError):
                await agent.__aenter__()
            assert agent.channel.lighthouse == MARKET


async def test_an_agent_that_could_not_start_may_be_started_later(router: EmbeddedRouter) -> None:
    await asyncio.to_thread(router.stop)
    agent = Agent(settings=Settings(connect=(router.endpoint,), connect_timeout=3.0))
    before = set(asyncio.all_tasks())
    with pytest.raises(NetworkUnavailable) as caught:
        await agent.__aenter__()
    assert "aira router" in caught.value.hint
    assert asyncio.all_tasks() == before
    await asyncio.to_thread(router.start)

    async def is_started() -> bool:
        try:
            async with agent:
                return await agent.channel.present() == []
        except NetworkUnavailable:  # a busy machine may need longer than this agent waits
            return False

    await until_found(is_started, what="the start of the agent")


async def test_leaving_ends_every_task_and_thread(place: Place) -> None:
    async with place.agent("person"):
        pass  # whatever Zenoh and asyncio keep for later is there now
    tasks = asyncio.all_tasks()
    threads = {thread for thread in threading.enumerate() if not thread.name.startswith("asyncio_")}
    robot = offering(place.agent("robot"))

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


async def test_agents_of_one_loop_are_independent(settings: Settings, channel: OpenChannel) -> None:
    heard: dict[str, list[Demand]] = {"one": [], "two": []}
    agents = [listening(Agent(settings=settings), heard[name]) for name in heard]
    async with agents[0]:
        async with agents[1]:
            # A subscriber of either agent may be known before that of the other one.
            await until(lambda: channel.publish(demand()) or all(heard.values()), pause=SOON)
        later = demand()
        channel.publish(later)
        await until(lambda: later in heard["one"])
    assert later not in heard["two"]


def listening(agent: Agent, heard: list[Demand]) -> Agent:
    @agent.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.append(message.message)

    return agent


async def test_a_job_handler_that_uses_the_agent_while_it_ends_does_not_fail_its_job(place: Place) -> None:
    """Ctrl-C must not fail and refund a job: the restarted agent resumes it."""
    robot = offering(place.agent("robot"))
    begun = asyncio.Event()

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
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


async def test_a_lost_router_does_not_end_an_agent(settings: Settings, router: EmbeddedRouter) -> None:
    agent = Agent(settings=settings)
    heard: list[Demand] = []
    async with listening(agent, heard):
        await asyncio.to_thread(router.stop)
        await asyncio.to_thread(router.start)
        async with (
            Network(Endpoints(connect=(router.endpoint,))) as network,
            OpenChannel(network.session, MarketRules(MARKET, address=LIGHTHOUSE)) as channel,
        ):
            await heard_on(channel, "demand")
            channel.publish(demand())
            await until(lambda: heard)


async def test_a_missing_router_raises_with_its_endpoint() -> None:
    endpoint = free_endpoint()
    with pytest.raises(NetworkUnavailable) as caught:
        async with Agent(settings=Settings(connect=(endpoint,), connect_timeout=0.1)):
            pass
    assert (caught.value.code, caught.value.endpoints) == ("network-unavailable", (endpoint,))

"""The agent as its user sees it: the messages its handlers receive, and the errors and logs it gives."""

from __future__ import annotations

import asyncio
import logging
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest

from mesh import Agent, Settings
from mesh.chain import KeyfileError, write_keyfile
from mesh.dev import JsonRpcServer
from mesh.errors import ConfigurationError
from schemas import Demand, Offer, Result, Verified, cid_of_bytes
from tests.support.agent.agents import SOON, channel, heard_on, settings
from tests.support.log_events import logged_facts
from tests.support.market import MODEL
from tests.support.orders import LIGHTHOUSE, demand, offer, result, verified_demand
from tests.support.raising import raises_with
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.agent.handlers import Job
    from tests.support.agent.agents import OpenChannel
from tests.support.market import Place

__all__ = ["channel", "settings"]

Order = Verified[Demand] | Verified[Offer]


async def test_an_agent_without_account_receives_messages_of_the_market(
    settings: Settings, channel: OpenChannel
) -> None:
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


async def test_an_agent_receives_only_orders_of_its_model(settings: Settings, channel: OpenChannel) -> None:
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
    settings: Settings, channel: OpenChannel, caplog: pytest.LogCaptureFixture
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
    assert logged_facts(caplog, "handler-crashed") == [{"handler": "crash", "error": "ZeroDivisionError"}] * 2
    assert caplog.text.count("raise ZeroDivisionError") == 2, "with its traceback"
    failed = {"handler": "complain", "code": "configuration-error"}
    assert logged_facts(caplog, "handler-failed") == [failed] * 2
    (complaint, _) = [record for record in caplog.records if vars(record).get("event") == "handler-failed"]
    assert complaint.levelno == logging.WARNING
    assert not complaint.exc_info
    assert logged_facts(caplog, "handler-cancelled") == [{"handler": "be_cancelled"}] * 2


async def test_a_late_agent_receives_all_of_many_open_orders(place: Place) -> None:
    """More of them than what waits between Zenoh and the agent."""
    late = place.agent("robot", model="")
    heard: set[bytes] = set()

    @late.on_demand
    async def hear(message: Verified[Demand]) -> None:
        heard.add(message.hash)

    deadline = await place.chains["provider"].block_number() + 10_000
    lighthouse = place.market.deployment.lighthouse
    orders = [verified_demand(lighthouse=lighthouse, cost=0, deadline=deadline) for _ in range(10_000)]
    async with place.provider() as provider:
        for order in orders:
            provider.book.add(order)
        async with late:
            await until(lambda: len(heard) + late.drops.totals().get("free-rate", 0) == len(orders), seconds=150)


async def test_a_periodic_handler_is_called_at_the_start_and_again_after_failures(settings: Settings) -> None:
    agent = Agent(settings=settings)
    calls = 0

    @agent.every(SOON)
    async def tick() -> None:
        nonlocal calls
        calls += 1
        raise ZeroDivisionError

    async with agent:
        await until(lambda: calls == 1)
        await until(lambda: calls >= 4)
    ended = calls
    await asyncio.sleep(3 * SOON)
    assert calls == ended


async def test_trading_without_account_raises(settings: Settings) -> None:
    async with Agent(settings=settings) as agent:
        for attempt in (
            agent.demand(cid_of_bytes(b"job")),
            agent.offer(objective=cid_of_bytes(b"job")),
            agent.contract(LIGHTHOUSE),
            agent.finish(LIGHTHOUSE, success=True),
        ):
            with pytest.raises(ConfigurationError) as caught:
                await attempt
            assert "keyfile" in caught.value.hint
        with pytest.raises(ConfigurationError):
            agent.address  # noqa: B018


async def test_two_handlers_for_one_topic_are_refused() -> None:
    agent = Agent(settings=Settings())

    async def handler(job: Job, message: Any) -> None:
        pass

    agent.on("/go")(handler)
    with raises_with(ConfigurationError, code="duplicate-handler", match="/go"):
        agent.on("/go")(handler)


async def test_a_working_agent_is_present_on_its_channel(place: Place) -> None:
    async with place.agent("person") as person, place.agent("robot"):

        async def both() -> bool:
            present = {(key.role, key.agent) for key in await person.channel.present()}
            return present == {("agent", place.address(role).lower()) for role in ("robot", "person")}

        await until_found(both)


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
            assert await robot.parts.chain.tokens.balance() == await place.balance("robot")
        await asyncio.to_thread(password.write_text, "open barley\n")
        with pytest.raises(KeyfileError, match="password"):
            await Agent(MODEL, settings=settings).__aenter__()


def test_importing_agents_loads_no_chain() -> None:
    """An agent that watches needs none, and may live where web3 is not installed."""
    program = "import sys, mesh.agent; print([name for name in ('web3', 'eth_abi', 'aiohttp') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"

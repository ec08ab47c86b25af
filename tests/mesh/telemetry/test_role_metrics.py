"""Metrics of a provider and an agent that do a job: each metric changes by what the job did, and by nothing else."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from mesh.agent.agent import Agent
from mesh.agent.handlers import JobFailed
from mesh.chain import NodeUnreachable
from mesh.market.provider import ProviderProcess
from mesh.network import Endpoints, Network
from mesh.telemetry.serving import Telemetry
from mesh.testing._market import working_provider
from schemas import Demand, Empty, Offer, cid_of_bytes
from schemas.status import ALIVE
from tests.support.market import MODEL, offering
from tests.support.objectives import objective
from tests.support.orders import demand
from tests.support.scraping import Scrape, health, scraped
from tests.support.waiting import until, until_found, until_heard

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import pytest

    from tests.support.market import Place
    from tests.support.routers import EmbeddedRouter

COST = 1000
LONG = 60.0
HERE = "127.0.0.1:0"
WELL = {"channel": ALIVE, "transactions": ALIVE, "listener": ALIVE}
AGENT_WELL = {"executor": ALIVE, "channel": ALIVE, "signer": ALIVE, "listener": ALIVE}


@asynccontextmanager
async def provider_at(place: Place) -> AsyncIterator[str]:
    """The lighthouse's provider at work; gives the URL of its metrics."""
    async with (
        asyncio.timeout(LONG),
        Telemetry(HERE) as telemetry,
        Network(Endpoints(connect=(place.endpoint,))) as network,
        working_provider(
            network.session, place.chains["provider"], place.market.deployment.lighthouse_name
        ) as provider,
    ):
        process = ProviderProcess(network, place.chains["provider"], [provider])
        with telemetry.showing(measure=process.measure, health=process.health):
            yield telemetry.url


def url_of(agent: Agent) -> str:
    """The URL of a running agent's metrics."""
    return agent.telemetry.url


def blinking(place: Place) -> Agent:
    """A robot that does its jobs and publishes messages; its metrics are served."""
    robot = offering(place.agent("robot", metrics_listen=HERE))

    @robot.on("/go")
    async def go(job: Any, message: Any) -> None:
        job.publish("/led", "on")
        job.publish("/led", "off")

    @robot.on("/break")
    async def fail(job: Any, message: Any) -> None:
        raise JobFailed("it is broken")

    return robot


async def settled(url: str, **expected: float) -> Scrape:
    """The metrics, when those named (without labels) have reached their values."""

    async def as_expected() -> bool:
        metrics = await scraped(url)
        return all(metrics(name) == value for name, value in expected.items())

    await until_found(as_expected, what=f"{expected}", seconds=LONG)
    return await scraped(url)


async def test_a_job_changes_exactly_these_metrics_of_its_provider(place: Place) -> None:
    lighthouse, customer = place.market.deployment.lighthouse_name, place.chains["person"]
    await customer.tokens.approve(customer.factory, 0)  # so that a permit is needed, whatever other tests have left
    async with provider_at(place) as url, blinking(place), place.agent("person") as person:
        before, eth = await scraped(url), await place.chains["provider"].tokens.eth_balance()
        contract = await person.demand(place.save(objective(("/go", Empty()))), model=MODEL, cost=COST)
        assert (await contract.outcome()).success
        after = await settled(url, aira_contracts_finalized_total=before("aira_contracts_finalized_total") + 1)
        changes = after.changes(before)

        assert changes.pop("aira_gas_spent_wei_total") == eth - await place.chains["provider"].tokens.eth_balance()
        assert changes.pop("aira_gas_used_total") > 100_000
        assert changes.pop("aira_minted_wn_total", 0) >= 0
        assert {name: value for name, value in changes.items() if "duplicate" not in name} == {
            "aira_messages_total{demand,accepted}": 1,
            "aira_messages_total{permit,accepted}": 1,
            "aira_messages_total{offer,accepted}": 1,
            "aira_messages_total{result,accepted}": 1,
            "aira_matches_total": 1,
            "aira_contracts_created_total": 1,
            "aira_contracts_finalized_total": 1,
            "aira_free_contracts_total": 1,
            "aira_transactions_total{sent}": 2,
            "aira_transactions_total{mined}": 2,
        }
        assert after.of_label("aira_matches_total", "lighthouse") == {lighthouse}
        assert after("aira_account_eth_wei") == float(await place.chains["provider"].tokens.eth_balance())
        assert after("aira_account_xrt_wn") == await place.balance("provider")
        assert after("aira_stake_wn") > 0
        assert after("aira_turn") == 1
        assert after("aira_chain_head_block") > before("aira_chain_head_block")
        assert after("aira_chain_read_age_seconds") < LONG
        assert (after("aira_orders_open"), after("aira_transactions_waiting")) == (0, 0)


async def test_a_job_changes_exactly_these_metrics_of_its_agent(place: Place) -> None:
    async with provider_at(place), blinking(place) as robot, place.agent("person") as person:
        url = url_of(robot)
        before = await scraped(url)
        path = place.save(objective(("/go", Empty()), ("/go", Empty())))
        contract = await person.demand(path, model=MODEL, cost=COST)
        assert (await contract.outcome()).success
        await until_found(lambda: _finalized(url, before("aira_jobs", phase="finalized") + 1), seconds=LONG)
        after = await scraped(url)
        changes = after.changes(before)

        fetched = changes.pop("aira_content_fetched_bytes_total")
        assert fetched == robot.parts.exchange.statistics().fetched_bytes >= path.stat().st_size
        assert {name: value for name, value in changes.items() if "duplicate" not in name} == {
            "aira_messages_total{demand,accepted}": 1,
            "aira_recorded_messages_total": 2 + 2 * 2,
        }
        assert [after("aira_outbox_messages", kind=kind) for kind in ("demand", "offer", "result")] == [0, 0, 0]
        assert after("aira_content_files") == before("aira_content_files") + 2, "the objective and the recording"
        assert after("aira_content_bytes") > before("aira_content_bytes") + fetched
        assert after("aira_content_quota_bytes") == robot.settings.content_limit
        assert after("aira_job_standing_seconds", phase="running") == 0
        assert after("aira_network_links") == 1


async def _finalized(url: str, count: float) -> bool:
    return (await scraped(url))("aira_jobs", phase="finalized") == count


async def test_the_age_of_a_running_job_in_its_phase_grows(place: Place) -> None:
    robot, done = offering(place.agent("robot", metrics_listen=HERE)), asyncio.Event()

    @robot.on("/go")
    async def go(job: Any, message: Any) -> None:
        await done.wait()

    async with provider_at(place), robot, place.agent("person") as person:
        contract = await person.demand(place.save(objective(("/go", Empty()))), model=MODEL, cost=COST)

        async def standing() -> float:
            metrics = await scraped(url_of(robot))
            return metrics("aira_job_standing_seconds", phase="running")

        await until_found(standing, what="a job under way", seconds=LONG)
        first = await standing()
        await asyncio.sleep(0.2)
        assert await standing() >= first + 0.15
        assert (await scraped(url_of(robot)))("aira_jobs", phase="running") == 1
        done.set()
        await contract.outcome()
        assert await standing() == 0


async def test_refused_messages_are_counted_by_reason(place: Place) -> None:
    async with provider_at(place) as url, place.agent("person") as person:
        before, session = await scraped(url), person.parts.network.session
        name = place.market.deployment.lighthouse_name
        await until_heard(session, f"aira/{name}/demand/{MODEL}")
        for payload in (b"rubbish", b"{}"):
            session.put(f"aira/{name}/demand/{MODEL}", payload)
        person.channel.publish(demand(model=MODEL, deadline=1, lighthouse=place.market.deployment.lighthouse))
        await until_found(lambda: _changed(url, before, 3), what="three refusals", seconds=LONG)
        changes = (await scraped(url)).changes(before)
        assert changes["aira_messages_total{demand,not-json}"] == 1
        assert changes["aira_messages_total{demand,deadline}"] == 1
        assert sum(changes.values()) == 3


async def _changed(url: str, before: Scrape, count: float) -> bool:
    return sum((await scraped(url)).changes(before).values()) >= count


async def test_the_loss_and_return_of_a_router_are_reported(place: Place, router: EmbeddedRouter) -> None:
    robot = blinking(place)
    async with provider_at(place) as url, robot:
        own = url_of(robot)
        for where, well in ((url, WELL), (own, AGENT_WELL)):
            await until_found(partial(_is, where, (200, well)), what="the start", seconds=LONG)
        await asyncio.to_thread(router.stop)
        for where, well in ((url, WELL), (own, AGENT_WELL)):
            lost = (503, {**well, "channel": "waits for a router"})
            await until_found(partial(_is, where, lost), what="the loss", seconds=LONG)
            metrics = await scraped(where)
            assert (metrics("aira_network_losses_total"), metrics("aira_network_links")) == (1, 0)
            assert (metrics("aira_part_up", part="channel"), metrics("aira_part_up", part="listener")) == (0, 1)
        await asyncio.to_thread(router.start)
        for where, well in ((url, WELL), (own, AGENT_WELL)):
            await until_found(partial(_is, where, (200, well)), what="the return", seconds=LONG)
            assert (await scraped(where))("aira_network_losses_total") == 1


async def _is(url: str, expected: tuple[int, dict[str, str]]) -> bool:
    return await health(url) == expected


async def test_an_agent_without_an_account_reports_what_it_receives(place: Place) -> None:
    watcher = Agent(MODEL, settings=place.settings("person", metrics_listen=HERE))
    heard: list[object] = []

    @watcher.on_offer
    async def hear(offer: object) -> None:
        heard.append(offer)

    async with watcher, place.agent("robot") as robot:
        assert await health(url_of(watcher)) == (200, {"channel": ALIVE})
        await robot.offer(objective=cid_of_bytes(b"x"), cost=COST)
        await until(lambda: heard, seconds=LONG)
        metrics = await scraped(url_of(watcher))
        assert metrics("aira_messages_total", kind="offer", verdict="accepted") == 1
        assert metrics("aira_messages_dropped_total", kind="offer") == 0
        assert metrics("aira_network_links") == 1


async def test_rejected_orders_are_counted_by_reason(place: Place) -> None:
    """The person revoked the allowance that the demand needs."""
    async with provider_at(place) as url, place.agent("robot") as robot, place.agent("person") as person:
        before = await scraped(url)
        terms = await person.runtime.trader.writer.terms(
            model=MODEL, objective=cid_of_bytes(b"x"), cost=10**15, token="", validator="", lifetime=1000
        )
        signed = await person.runtime.trader.writer.sign(Demand, terms, validator_fee=0)
        name = place.market.deployment.lighthouse_name
        await until_heard(person.parts.network.session, f"aira/{name}/demand/{MODEL}")
        person.channel.publish(signed)
        await robot.runtime.trader.post(Offer, robot.runtime.trader.writer.terms_of(signed), lighthouse_fee=0)

        async def rejected() -> bool:
            changes = (await scraped(url)).changes(before)
            return any(name.startswith("aira_rejections_total") for name in changes)

        await until_found(rejected, what="a rejection", seconds=LONG)
        changes = (await scraped(url)).changes(before)
        assert changes["aira_rejections_total{ERC20InsufficientAllowance}"] == 1
        assert "aira_contracts_created_total" not in changes


async def test_a_balance_that_the_node_does_not_return_is_left_out(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain = place.chains["robot"]

    async def unreachable(address: str | None = None) -> int:
        raise NodeUnreachable("http://there", "it is away")

    async with provider_at(place), blinking(place) as robot:
        assert "aira_account_eth_wei" in (await scraped(url_of(robot))).names()
        monkeypatch.setattr(chain.node, "eth_balance", unreachable)
        metrics = await scraped(url_of(robot))
        assert "aira_account_eth_wei" not in metrics.names()
        assert metrics.of_label("aira_jobs", "phase")

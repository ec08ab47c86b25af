"""Whole jobs across the bridge: parties on IPFS PubSub trade with parties on Zenoh."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from bridges.ipfs.service import IpfsBridge
from mesh.base.background import Background
from mesh.dev.development import ROLES
from mesh.network import Endpoints, Network
from schemas import Demand, Offer, Result, decode
from tests.support.ipfs_bridge.legacy import LegacyTrader
from tests.support.market import MODEL, Place, offering
from tests.support.objectives import objective
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from mesh.agent.agent import Agent
    from mesh.agent.handlers import Job
    from schemas import Liability
    from tests.bridges.ipfs.conftest import Swarm


SECONDS = 90.0
COST = 321


def trader(place: Place, role: str, api: str) -> LegacyTrader:
    key = place.node.funded_keys[ROLES.index(role)]
    return LegacyTrader(api, place.market.deployment.lighthouse_name, key)


@asynccontextmanager
async def bridge(place: Place, swarm: Swarm) -> AsyncIterator[IpfsBridge]:
    """The whole bridge, at daemon A."""
    settings = replace(place.settings("bridge"), ipfs_http_provider=swarm.a.api)
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        IpfsBridge(network, settings, chain=lambda: place.chain("provider")) as bridge,
        Background() as tasks,
    ):
        tasks.start(bridge.run(), "bridge of the test")
        yield bridge


async def terms(place: Place, name: str) -> dict[str, Any]:
    deployment, chain = place.market.deployment, place.chains["provider"]
    deadline = await chain.block_number() + 10_000
    order = {"model": MODEL, "objective": name, "token": deployment.xrt, "cost": COST}
    return order | {"lighthouse": deployment.lighthouse, "deadline": deadline}


async def liability_of(place: Place, since: int, **parties: str) -> Liability:
    """The contract created, as read from the chain."""
    chain = place.chains["provider"]

    async def made() -> Sequence[Liability]:
        return await chain.liabilities.list(from_block=since, **parties)

    await until_found(made, what="a contract", seconds=SECONDS)
    return (await made())[0]


async def is_paid(place: Place, address: str) -> bool:
    liability = await place.chains["provider"].liabilities.get(address)
    return liability.is_finalized and liability.is_success


async def all_meet(bridge: IpfsBridge, *traders: LegacyTrader) -> None:
    topic = bridge.channels[0].lighthouse
    for one in traders:
        await one.listen(topic)
    await until(lambda: bridge.channels[0].status().state == "connected", seconds=SECONDS)
    for one in traders:
        await until_found(lambda one=one: one.peers(topic), seconds=SECONDS)  # type: ignore[misc]


@pytest.fixture
async def since(place: Place) -> int:
    """The first block of this test on the shared chain."""
    return await place.chains["provider"].block_number() + 1


async def test_a_provider_on_zenoh_serves_promisee_and_robot_on_ipfs(place: Place, swarm: Swarm, since: int) -> None:
    async with (
        place.provider(),
        bridge(place, swarm) as bridged,
        trader(place, "person", swarm.b.api) as person,
        trader(place, "robot", swarm.b.api) as robot,
    ):
        await all_meet(bridged, person, robot)
        await place.chains["person"].tokens.approve(place.chains["person"].factory, COST)
        before = await place.balance("robot")
        await person.send(person.demand(**await terms(place, await person.add(b"what to do"))))
        await robot.send(robot.offer(await robot.receive("validatorFee")))
        liability = await liability_of(place, since, promisee=person.address, promisor=robot.address)
        await robot.send(robot.result(liability.address, await robot.add(b"what was done")))
        await until_found(lambda: is_paid(place, liability.address), what="the payment", seconds=SECONDS)
        assert await place.balance("robot") == before + COST


async def test_a_provider_on_ipfs_serves_promisee_and_robot_on_zenoh(place: Place, swarm: Swarm) -> None:
    chain, market = place.chains["provider"], place.market.deployment.lighthouse
    async with (
        bridge(place, swarm) as bridged,
        trader(place, "provider", swarm.b.api) as provider,
        working(place.agent("robot")),
        place.agent("person") as person,
    ):
        await all_meet(bridged, provider)
        asked = asyncio.create_task(person.demand(place.save(objective(("/go", "there"))), cost=COST))
        demand = read(await provider.receive("validatorFee"), Demand)
        offer = read(await provider.receive("lighthouseFee", objective=demand.objective), Offer)
        created = await chain.liabilities.create(market, demand, offer)
        result = read(await provider.receive("liability", liability=created.liability), Result)
        await chain.liabilities.finalize(market, result)
        outcome = await (await asked).outcome()
        assert (outcome.success, outcome.result) == (True, result.result)
        # Files of the mesh are on IPFS, where legacy clients find them.
        recording = await (await asked).recording()
        await until(lambda: bridged.content.metrics().added >= 2, what="objective and result on IPFS", seconds=SECONDS)
        assert await provider.cat(result.result) == recording.read_bytes()


async def test_a_promisee_on_zenoh_gets_the_work_of_a_robot_on_ipfs_and_its_recording(
    place: Place, swarm: Swarm
) -> None:
    done = objective(("/done", "well"))
    async with (
        place.provider(),
        bridge(place, swarm) as bridged,
        trader(place, "robot", swarm.b.api) as robot,
        place.agent("person") as person,
    ):
        await all_meet(bridged, robot)
        task = place.save(objective(("/go", "there")))
        asked = asyncio.create_task(person.demand(task, cost=COST))
        demand = await robot.receive("validatorFee")
        await until(lambda: bridged.content.metrics().added == 1, what="the objective on IPFS", seconds=SECONDS)
        assert await robot.cat(demand["objective"]) == task.read_bytes()
        await robot.send(robot.offer(demand))
        contract = await asked
        await robot.send(robot.result(contract.address, await robot.add(done)))
        assert (await contract.outcome()).success
        assert (await contract.recording()).read_bytes() == done


async def test_a_robot_on_zenoh_works_for_a_promisee_on_ipfs(place: Place, swarm: Swarm, since: int) -> None:
    async with (
        place.provider(),
        bridge(place, swarm) as bridged,
        trader(place, "person", swarm.b.api) as person,
        working(place.agent("robot")) as robot,
    ):
        await all_meet(bridged, person)
        await place.chains["person"].tokens.approve(place.chains["person"].factory, COST)
        task = await person.add(objective(("/go", "there")))
        await person.send(person.demand(**await terms(place, task)))
        liability = await liability_of(place, since, promisee=person.address, promisor=robot.address)
        await until_found(lambda: is_paid(place, liability.address), what="the payment", seconds=SECONDS)
        result = await person.receive("liability", liability=liability.address)
        await until(lambda: bridged.content.metrics().added == 1, what="the result on IPFS", seconds=SECONDS)
        assert await person.cat(result["result"])


def working(robot: Agent) -> Agent:
    """The robot, accepting every job and message."""

    @robot.on("*")
    async def nothing(job: Job, message: Any) -> None:
        pass

    return offering(robot)


def read(message: dict[str, Any], kind: type[Any]) -> Any:
    """The message as a struct, for the chain's client."""
    read = decode(json.dumps(message).encode())
    assert isinstance(read, kind)
    return read

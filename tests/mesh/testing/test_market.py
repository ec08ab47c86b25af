"""`mesh.testing.Market`: whole jobs in one process, and what can go wrong with them."""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mesh import XRT, Agent, AiraError, Declined, Demand, DemandDeclined, Job, JobFailed, Settings, Verified
from mesh.chain import NodeUnreachable
from mesh.testing import Market, assert_declined, assert_paid, assert_refunded
from schemas import Withdrawal

if TYPE_CHECKING:
    from mesh.testing import MarketChain

ANYTHING = "QmTH8nmTYpLtoMXvrkG18CeKBcT926SBYLCTjiGmvtLE82"
PRICE = XRT.parse("3 XRT")


class Forklift(Agent):
    """Lifts for 3 XRT; a lift above 4 m fails, and one of 0 m waits until `released`."""

    def __init__(self) -> None:
        super().__init__()
        self.released = asyncio.Event()
        self.lifts = 0
        self.on_demand(self._offer)
        self.on("/lift", float)(self._lift)

    async def _offer(self, demand: Verified[Demand]) -> None:
        if demand.message.cost < PRICE:
            raise Declined("too-cheap", "a job costs 3 XRT")
        await self.offer(demand)

    async def _lift(self, job: Job, metres: float) -> None:
        self.lifts += 1
        if metres > 4:
            raise JobFailed("the battery is empty", code="battery-empty")
        if not metres:
            await self.released.wait()
        job.publish("/height", metres)


@pytest.fixture
def forklift() -> Forklift:
    return Forklift()


async def test_a_job_is_paid_and_its_recording_is_at_hand(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        person, before = await market.person(), await market.balance(forklift)
        outcome = await market.order(forklift, [("/lift", 1.5), ("/lift", 2.0)], by=person, cost="5 XRT")

        assert_paid(outcome)
        assert outcome.recording.values("/height") == [1.5, 2.0]
        assert outcome.recording.published == [("/height", 1.5), ("/height", 2.0)]
        assert outcome.robot == forklift.address
        assert await market.balance(forklift) == before + XRT.parse("5 XRT")
        assert await market.balance(person) == XRT.parse("995 XRT")


async def test_a_failed_job_and_a_declined_one_say_why(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        assert_refunded(await market.order(forklift, [("/lift", 5.0)], cost=PRICE), code="battery-empty")
        with pytest.raises(DemandDeclined) as caught:
            await market.order(forklift, [("/lift", 1.5)], cost="1 XRT")
        assert_declined(caught.value, code="too-cheap")


async def test_nobody_polls_the_node(market: Market, forklift: Forklift, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    ask = market.chain.node.request

    async def request(method: str, params: object) -> object:
        asked.append(method)
        return await ask(method, params)

    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        monkeypatch.setattr(market.chain.node, "request", request)
        forklift.released.set()
        assert_paid(await market.outcome(contract))
        assert asked.count("eth_getBlockByNumber") <= 3, asked


async def test_a_model_is_ordered_of_any_robot(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        assert_paid(await market.order(ANYTHING, [("/lift", 1.5)], cost=PRICE))


async def test_markets_that_follow_each_other_know_nothing_of_each_other(
    market_chain: MarketChain, forklift: Forklift
) -> None:
    seen = []
    for _ in range(2):
        async with Market(market_chain) as market, market.robot(forklift):
            assert_paid(await market.order(forklift, [("/lift", 1.0)], cost=PRICE))
            seen.append((market.lighthouse, market.endpoint, forklift.address, await market.balance(forklift)))
    (first, second) = seen
    assert not set(first[:3]) & set(second[:3])
    assert first[3] == second[3] == XRT.parse("1003 XRT")


async def test_a_robot_has_its_own_settings_again_afterwards(market: Market) -> None:
    own = Settings(connect=("tcp/127.0.0.1:1",), name="Alice", keyfile="/nowhere.json")
    robot = Agent(settings=own)
    async with market.robot(robot):
        assert robot.settings.name == "Alice"
        assert robot.settings.connect != own.connect
    assert robot.settings == own


async def test_a_job_is_stopped_once_it_runs(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.stop(contract, "enough")
        outcome = await market.outcome(contract)
        assert_refunded(outcome, code="stopped")
        assert "enough" in outcome.reason


async def test_a_killed_robot_goes_on_where_it_was_and_is_paid_once(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 1.0), ("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        address, before = forklift.address, await market.balance(forklift)
        await market.kill(forklift)
        assert not forklift.is_open
        with pytest.raises(AiraError) as caught:
            await market.kill(forklift)
        assert caught.value.code == "closed-error"

        forklift.released.set()
        await market.restart(forklift)
        assert_paid(await market.outcome(contract))
        assert (forklift.address, await market.balance(forklift)) == (address, before + PRICE)


async def test_a_killed_robot_says_nothing_more(market: Market) -> None:
    killed, ended = Agent(ANYTHING), Agent(ANYTHING)
    watcher = await market.person()
    async with watcher.channel.subscribe(Withdrawal) as withdrawals, market.robot(killed):
        async with market.robot(ended):
            for robot in (killed, ended):
                await robot.offer(objective=ANYTHING)
            await market.kill(killed)
            address = ended.address
        # One that ends in good order withdraws its offer.
        assert (await anext(withdrawals)).signer == address


async def test_a_robot_at_work_is_restarted_in_good_order(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        assert_paid(await market.order(forklift, [("/lift", 1.0)], cost=PRICE))
        await market.restart(forklift)
        assert_paid(await market.order(forklift, [("/lift", 1.0)], cost=PRICE))


async def test_a_contract_that_a_reorganisation_reverts_is_made_again_and_paid_once(
    market: Market, forklift: Forklift
) -> None:
    async with market.robot(forklift):
        before = await market.balance(forklift)
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        await market.reorg(1)
        forklift.released.set()
        assert_paid(await market.outcome(contract))
        assert await market.balance(forklift) == before + PRICE


async def test_a_reorganisation_can_not_take_the_market_away(market: Market) -> None:
    for depth in (0, 10_000):
        with pytest.raises(AiraError) as caught:
            await market.reorg(depth)
        assert caught.value.code == "too-deep"


async def test_orders_expire_when_blocks_are_mined(market: Market) -> None:
    person = await market.person()
    order = await person.order([("/lift", 1.0)], model=ANYTHING, lifetime=5)
    await market.mine(6)
    with pytest.raises(AiraError) as caught:
        await order.contract(wait=True)
    assert caught.value.code == "order-expired"


async def test_what_does_not_come_about_is_an_error_that_says_so(market: Market, forklift: Forklift) -> None:
    with pytest.raises(AiraError) as caught:
        await market.order(ANYTHING, [("/lift", 1.0)], timeout=0.5)
    assert caught.value.code == "no-contract"
    with pytest.raises(AiraError) as caught:
        await market.order(forklift, [("/lift", 1.0)])
    assert caught.value.code == "closed-error"
    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        with pytest.raises(AiraError) as caught:
            await market.outcome(contract, timeout=0.2)
        assert caught.value.code == "no-outcome"
        forklift.released.set()
        assert_paid(await market.outcome(contract))


async def test_a_robot_that_can_not_start_says_why(market: Market) -> None:
    with pytest.raises(AiraError, match=re.escape("can't read the model")):
        async with market.robot(Agent(Path("/nowhere.json"))):
            """It does not come here."""


async def test_a_job_that_ends_without_a_node_is_paid_when_the_node_is_back(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        async with market.node_down():
            with pytest.raises(NodeUnreachable):
                await market.balance(forklift)
            forklift.released.set()
        assert_paid(await market.outcome(contract))


async def test_a_robot_without_a_connection_is_paid_once_it_is_back(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        async with market.partition(forklift):
            assert not forklift.network.connected
            forklift.released.set()
            with pytest.raises(AiraError) as caught:
                await market.outcome(contract, timeout=0.5)
            assert caught.value.code == "no-outcome"
        assert_paid(await market.outcome(contract))


async def test_a_robot_without_a_connection_gets_no_orders(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift), market.partition(forklift):
        with pytest.raises(AiraError) as caught:
            await market.order(ANYTHING, [("/lift", 1.0)], cost=PRICE, timeout=0.5)
        assert caught.value.code == "no-contract"


async def test_a_robot_with_a_full_disk_fails_and_goes_on_when_there_is_room(
    market: Market, forklift: Forklift
) -> None:
    async with market.robot(forklift, disk=16 * 1024 * 1024):
        contract = await market.demand(forklift, [("/lift", 0.0)], cost=PRICE)
        await market.running(contract)
        with market.disk_full(forklift):
            forklift.released.set()
            with pytest.raises(AiraError) as caught:
                await market.outcome(contract, timeout=0.5)
            assert caught.value.code == "no-outcome"
        await market.restart(forklift)
        assert_paid(await market.outcome(contract))


async def test_only_a_disk_of_its_own_is_filled(market: Market, forklift: Forklift) -> None:
    async with market.robot(forklift):
        with pytest.raises(AiraError) as caught, market.disk_full(forklift):
            """It does not come here."""
        assert caught.value.code == "no-disk"


async def test_the_clock_is_brought_forward_for_handlers_and_for_the_chain(market: Market) -> None:
    robot, woke = Agent(ANYTHING), list[str]()
    robot.on_demand(lambda demand: robot.offer(demand))

    @robot.on("/wait", float)
    async def wait(job: Job, seconds: float) -> None:
        await asyncio.sleep(seconds)
        woke.append(f"{seconds:g}")
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await asyncio.Event().wait()
        job.publish("/waited", 2 * seconds)

    async with market.robot(robot):
        contract = await market.demand(robot, [("/wait", 300.0), ("/wait", 100.0)], cost="1 XRT")
        await market.running(contract)
        before = await robot.chain.block_number()
        await market.clock.advance(200)
        assert woke == []
        assert await robot.chain.block_number() == before + 200
        await market.clock.advance(100)
        assert woke == ["300"]
        await market.clock.advance(500)
        outcome = await market.outcome(contract)
        assert_paid(outcome)
        assert outcome.recording.values("/waited") == [600.0, 200.0]
    with pytest.raises(AiraError) as caught:
        await market.clock.advance(-1)
    assert caught.value.code == "not-a-time"


async def test_orders_expire_when_the_clock_is_brought_forward(market: Market) -> None:
    person = await market.person()
    order = await person.order([("/lift", 1.0)], model=ANYTHING, lifetime=5)
    await market.clock.advance(6)
    with pytest.raises(AiraError) as caught:
        await order.contract(wait=True)
    assert caught.value.code == "order-expired"


async def test_the_event_loop_has_its_own_clock_again_after_each_market() -> None:
    loop = asyncio.get_running_loop()
    before = loop.call_at
    async with Market():
        async with Market():
            pass
        await asyncio.sleep(0.001)
    assert loop.call_at == before

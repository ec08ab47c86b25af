"""What strangers make a robot offer: bounded in number, in time and in messages, across restarts."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import pytest

from mesh.agent.offers import OpenOffers, TooManyOffers
from mesh.network import Endpoints, Network
from mesh.work.outbox import RESEND_RATE, outgoing
from schemas import market_selector
from tests.mesh.agent.test_demand_floods import dead_demand, stranger
from tests.mesh.agent.trades import waiting
from tests.support import orders
from tests.support.market import Place, offering_unseen
from tests.support.waiting import until

FAR = 10**9
"""A deadline that a stranger chose."""


def test_the_maker_with_the_most_offers_loses_its_newest() -> None:
    offers = OpenOffers(per_maker=3, total=4)
    assert [offers.add(f"f{n}", "flood", pays=True) for n in range(3)] == [""] * 3
    with pytest.raises(TooManyOffers):
        offers.add("f3", "flood", pays=True)
    assert offers.add("a0", "alice", pays=False) == ""
    assert offers.add("b0", "bob", pays=False) == "f2"
    assert offers.add("c0", "carol", pays=False) == "f1"
    assert offers.add("d0", "dave", pays=True) == "a0"
    assert offers.add("e0", "erin", pays=True) == "b0"
    offers.discard("e0")
    assert offers.add("g0", "gina", pays=True) == ""
    assert len(offers) == 4


def test_offers_of_earlier_runs_count_as_one_makers() -> None:
    offers = OpenOffers(per_maker=2, total=3)
    assert [offers.add(f"old{n}", "", pays=False) for n in range(3)] == [""] * 3
    assert offers.add("new", "alice", pays=False) == "old2"


async def test_a_strangers_deadline_is_not_copied_into_an_offer(place: Place) -> None:
    robot = offering_unseen(place.agent("robot", deadline_limit=50))
    async with robot, stranger(place) as channel:
        channel.publish(dead_demand(place, cost=0, deadline=FAR))
        await until(robot.orders)
        head = await place.chains["robot"].block_number()
        assert head < robot.orders()[0].deadline <= head + 50


async def test_three_thousand_offers_are_not_sent_at_once_after_a_restart(place: Place) -> None:
    """They are in the ledger of a robot that had no bound."""
    robot, signer = place.agent("robot"), place.market.accounts["robot"].signer
    terms: dict[str, Any] = {"lighthouse": place.market.deployment.lighthouse, "cost": 0, "deadline": FAR}
    async with robot:
        offers = [outgoing(orders.offer(signer=signer, **terms)) for _ in range(3000)]
        await asyncio.gather(*map(robot.parts.ledger.post, offers))
    heard: list[float] = []
    began = time.monotonic()
    async with Network(Endpoints(connect=(place.endpoint,))) as network, place.agent("robot") as robot:
        selector = market_selector(place.market.deployment.lighthouse_name, "offer")
        network.session.declare_subscriber(selector, lambda _sample: heard.append(time.monotonic()))
        await until(lambda: len(heard) >= RESEND_RATE.burst)
        await asyncio.sleep(3)
        allowed = RESEND_RATE.burst + RESEND_RATE.per_second * (heard[-1] - began + 1)
        assert len(heard) <= allowed
        assert len(robot.orders()) < 3000
        assert len(await waiting(robot)) == len(robot.orders())

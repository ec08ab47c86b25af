"""What strangers make a robot offer: bounded in number, in time and in messages, across restarts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.orders import OpenOffers, TooManyOffers, TradedOrder
from schemas import cid_of_file
from tests.mesh.agent.test_demand_floods import dead_demand, stranger
from tests.support import orders
from tests.support.market import Place, offering_unseen
from tests.support.objectives import objective
from tests.support.waiting import until

if TYPE_CHECKING:
    from schemas import Demand, Verified

FAR = 10**9
"""A deadline that a stranger chose."""


def made() -> TradedOrder:
    """An offer."""
    return TradedOrder(orders.offer(), posted=0.0)


def test_the_maker_with_the_most_offers_loses_its_newest() -> None:
    offers = OpenOffers(per_maker=3, total=4)
    flood, others = [made() for _ in range(3)], {maker: made() for maker in ("alice", "bob", "carol", "dave", "erin")}
    assert [offers.add(offer, "flood", pays=True) for offer in flood] == [None] * 3
    with pytest.raises(TooManyOffers):
        offers.add(made(), "flood", pays=True)
    assert offers.add(others["alice"], "alice", pays=False) is None
    assert offers.add(others["bob"], "bob", pays=False) is flood[2]
    assert offers.add(others["carol"], "carol", pays=False) is flood[1]
    assert offers.add(others["dave"], "dave", pays=True) is others["alice"]
    assert offers.add(others["erin"], "erin", pays=True) is others["bob"]
    offers.discard(others["erin"])
    assert offers.add(made(), "gina", pays=True) is None
    assert len(offers) == 4


async def test_a_strangers_deadline_is_not_copied_into_an_offer(place: Place) -> None:
    robot = offering_unseen(place.agent("robot", deadline_limit=50))
    async with robot, stranger(place) as channel:
        channel.publish(dead_demand(place, cost=0, deadline=FAR))
        await until(robot.orders)
        head = await place.chains["robot"].block_number()
        assert head < robot.orders()[0].deadline <= head + 50


async def test_a_demand_of_generation_5_that_is_signed_again_is_not_offered_again(place: Place) -> None:
    """The offer for its earlier version matches the new one, too."""
    robot = place.agent("robot")
    answers: list[str] = []

    @robot.on_demand
    async def offer(demand: Verified[Demand]) -> None:
        answers.append(await robot.offer(demand))

    path, signer = place.save(objective(("/go", "there"))), place.market.accounts["person"].signer
    terms: dict[str, Any] = {"cost": 0, "deadline": await place.chains["robot"].block_number() + 50}
    terms |= {"sender": signer.address, "objective": cid_of_file(path)}
    async with robot, stranger(place) as channel:
        await robot.add(path)
        first = await place.chains["robot"].liabilities.next_nonce(signer.address)
        for nonce, deadline in ((0, 0), (1, 0), (1, 1)):
            changes = terms | {"nonce": first + nonce, "deadline": terms["deadline"] - deadline}
            channel.publish(dead_demand(place, signer, **changes))
            await until(lambda: len(answers) > nonce + deadline)  # noqa: B023
        assert answers[0] == answers[1] != answers[2]
        assert sorted(order.hash for order in robot.orders()) == sorted(answers[1:])

from forklift import forklift

from mesh.testing import FakeJob, Market, assert_paid, run

LIFTS = [("/lift", 0.3), ("/lift", 0.1), ("/lift", 0.4)]


async def test_it_gives_up_when_its_battery_is_empty() -> None:
    outcome = await run(forklift(battery=0.4), FakeJob(LIFTS))
    assert (outcome.code, outcome.recording.values("/height")) == ("battery-empty", [0.3, 0.1])


async def test_the_dearer_one_does_what_the_cheap_one_gave_back(market: Market) -> None:
    bob, alice = forklift("1 XRT", battery=0.4), forklift("3 XRT")
    async with market.robot(bob), market.robot(alice):
        outcome = await market.order(bob.model, LIFTS, robot="cheapest", max_cost="20 XRT", retry=1)
        assert_paid(outcome)
        assert (outcome.earlier[0].robot, outcome.robot) == (bob.address, alice.address)

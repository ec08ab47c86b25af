"""A power cut at the commit of a position: a success has everything in its recording that was played."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from mesh.recording import open_objective
from mesh.validator.verification import Claim, JobFiles, verify
from schemas import String
from tests.support.agent.power import powered_robot
from tests.support.agent.restarts import COST, SAYING, WORDS, Paying, paid, speaking
from tests.support.log_events import logged_facts
from tests.support.objectives import objective

if TYPE_CHECKING:
    import pytest

    from mesh.testing import MarketChain
    from tests.support.market import Place

__all__ = ["paid"]

ROBOT = 1
"""Place of the robot's key among those of the chain."""


async def test_a_success_after_a_power_cut_has_a_complete_recording(
    market_chain: MarketChain, place: Place, paid: Paying
) -> None:
    """Killed when the ledger says that all was played, before the recording is closed."""
    said: list[str] = []
    task = place.save(objective(*SAYING))
    async with place.provider(), place.agent("person") as person:
        async with powered_robot(place, market_chain.node.funded_keys[ROBOT], last=len(WORDS)) as powered:
            contract = await person.demand(task, cost=COST)
            await powered.lose_power()
        async with speaking(place.agent("robot"), said):
            assert (await contract.outcome()).success
            recording = await contract.recording()
        claim = Claim.of_contract((await person.contract(contract.address)).liability)
    messages = [(one.topic, String.decode(one.payload).data) for one in open_objective(recording).messages()]
    assert said == [], "the ledger knew that all was played"
    assert [data for topic, data in messages if topic == "/say"] == WORDS
    assert [data for topic, data in messages if topic == "/said"] == WORDS, "what the handlers published is synced, too"
    verdict = await asyncio.to_thread(verify, claim, JobFiles(objective=task, result=recording))
    assert verdict.holds
    assert await paid.once()


async def test_a_job_whose_recording_lost_what_was_played_is_no_success(
    market_chain: MarketChain, place: Place, paid: Paying, caplog: pytest.LogCaptureFixture
) -> None:
    """As on a disk that loses what it has confirmed: the promisee is refunded."""
    said: list[str] = []
    async with place.provider(), place.agent("person") as person:
        async with powered_robot(place, market_chain.node.funded_keys[ROBOT], last=len(WORDS)) as powered:
            contract = await person.demand(SAYING, cost=COST)
            await powered.lose_power(keeps="nothing")
        async with speaking(place.agent("robot"), said) as robot:
            assert not (await contract.outcome()).success
            job = await robot.parts.ledger.job(contract.address)
    assert job is not None
    assert job.success is False
    assert {"code": "recording-incomplete"} in logged_facts(caplog, "job-failed")
    assert not await paid.once()

"""Failures during a job: each time the job is paid exactly once, without help of an operator.

All faults happen to one market, one after the other: what one has left behind must not hurt the next.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from tests.support.deployment import CUT_SECONDS, ComposeDeployment, Images, passed

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.compose

PLAYED_SECONDS = 8


@pytest.fixture(scope="module")
def market(images: Images, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ComposeDeployment]:
    with ComposeDeployment(images, tmp_path_factory.mktemp("faults")) as running:
        running.up()
        yield running


@pytest.mark.parametrize("service", ["router", "provider", "agent"])
async def test_a_job_is_paid_after_a_service_was_killed_and_restarted(market: ComposeDeployment, service: str) -> None:
    await market.ready()
    job = market.ask(PLAYED_SECONDS)
    await job.is_played()
    market.kill(service)
    assert not job.is_over()
    market.start(service)
    assert (await job.settled())["success"]


async def test_a_job_is_paid_after_the_chain_was_killed_and_restarted_with_its_state(
    market: ComposeDeployment,
) -> None:
    await market.ready()
    job = market.ask(PLAYED_SECONDS)
    await job.is_played()
    created = time.time()
    await market.until(lambda: saved(market) > created, what="the chain's state to be saved", seconds=60)
    market.kill("chain")
    market.start("chain")
    assert (await job.settled())["success"]


async def test_a_job_is_paid_after_its_robot_was_disconnected_for_half_a_minute(market: ComposeDeployment) -> None:
    await market.ready()
    job = market.ask(PLAYED_SECONDS)
    await job.is_played()
    market.disconnect("agent")
    # It plays on by itself; its Result reaches nobody until it is joined again.
    await passed(CUT_SECONDS)
    assert not job.is_over()
    market.connect("agent")
    assert (await job.settled())["success"]


async def test_a_job_is_paid_after_its_robot_was_paused(market: ComposeDeployment) -> None:
    await market.ready()
    job = market.ask(PLAYED_SECONDS)
    await job.is_played()
    market.pause("agent")
    # Longer than Zenoh's lease: the others take it for gone.
    await passed(15)
    assert not job.is_over()
    market.unpause("agent")
    assert (await job.settled())["success"]


def saved(market: ComposeDeployment) -> float:
    """When the chain's state was last written, seconds of this machine's clock."""
    return float(market.execute("chain", "stat", "--format=%Y", "/var/lib/aira/chain.json"))

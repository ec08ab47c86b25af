"""Two sites with a router each, linked: the robot and its provider at one, the person at the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.deployment import CUT_SECONDS, TWO_SITES, ComposeDeployment, Images, passed

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.compose

PLAYED_SECONDS = 5


@pytest.fixture(scope="module")
def sites(images: Images, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ComposeDeployment]:
    with ComposeDeployment(images, tmp_path_factory.mktemp("sites"), file=TWO_SITES) as running:
        running.up()
        yield running


async def test_a_person_at_one_site_gets_a_job_done_by_a_robot_at_the_other(sites: ComposeDeployment) -> None:
    await sites.ready()
    assert "paid, result Qm" in sites.log("person")
    assert sites.networks("person").isdisjoint(sites.networks("agent") - {"wan"})
    assert "router-north" in sites.variable("agent", "AIRA_CONNECT").split(",")[0]
    assert "router-south" in sites.variable("person", "AIRA_CONNECT").split(",")[0]


async def test_a_job_is_paid_after_a_site_was_disconnected_for_half_a_minute(sites: ComposeDeployment) -> None:
    await sites.ready()
    job = sites.ask(PLAYED_SECONDS)
    await job.is_played()
    # The whole site of the robot: its router too loses the other one.
    north = ("router-north", "provider", "agent", "chain")
    for service in north:
        sites.disconnect(service, "wan")
    await passed(CUT_SECONDS)
    assert not job.is_over()
    for service in north:
        sites.connect(service, "wan")
    assert (await job.settled())["success"]


async def test_clients_with_two_endpoints_continue_when_one_router_is_down(sites: ComposeDeployment) -> None:
    await sites.ready()
    job = sites.ask(PLAYED_SECONDS)
    await job.is_played()
    sites.kill("router-north")
    assert (await job.settled())["success"]
    # A job from the beginning to the end, while that router is still dead.
    assert (await sites.ask(1).settled())["success"]
    assert not sites.is_running("router-north")

"""What an agent's services refuse, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.agent import Phase
from mesh.network import ServiceFailed
from schemas import ZERO_ADDRESS, cid_of_bytes
from schemas.rpc import (
    Done,
    FinishLiability,
    LiabilityRead,
    ReadLiability,
    RestartLiability,
    ResumeLiability,
    StartLiability,
)
from tests.mesh.agent.controls import Control, control, controlled, person, ready
from tests.support.market import in_phase, offering_unseen

if TYPE_CHECKING:
    from mesh.agent import Agent
    from tests.support.market import Place

__all__ = ["control", "person"]


async def test_what_the_phase_does_not_allow_is_answered_with_the_reason(
    place: Place, control: Control, person: Agent
) -> None:
    contract = await ready(control, person, place)
    address = contract.address
    await control.start(address)
    assert await control.start(address) == Done(False, f"can't start {address}: it is running")
    resumed = await control.ask("resume", ResumeLiability(address))
    assert resumed == Done(False, f"can't resume {address}: it is running")
    await control.finish(address)
    with pytest.raises(ServiceFailed, match=f"can't move to complete {address}: it is"):
        await control.finish(address)
    for service, request in (("start", StartLiability), ("restart", RestartLiability), ("resume", ResumeLiability)):
        done = await control.ask(service, request(address))
        assert not done.success
        assert done.msg.startswith(f"can't {service} {address}: it is ")


async def test_a_job_whose_objective_has_not_come_can_not_be_started(place: Place) -> None:
    robot = offering_unseen(place.agent("robot", fetch_timeout=30.0))
    async with controlled(place, robot) as control, place.agent("person") as person:
        contract = await person.demand(cid_of_bytes(b"nobody's"))
        await in_phase(robot, contract, Phase.INCOMING)
        done = await control.start(contract.address)
        assert done == Done(False, f"can't start {contract.address}: it is incoming")
        await control.finish(contract.address, success=False)
        assert not (await contract.outcome()).success


async def test_unknown_liabilities_are_no_jobs(control: Control) -> None:
    done = await control.start(ZERO_ADDRESS)
    assert done == Done(False, f"can't start {ZERO_ADDRESS}: it is not a job of this agent")
    assert await control.read(ZERO_ADDRESS) == LiabilityRead(False)
    with pytest.raises(ServiceFailed, match="is not a job of this agent"):
        await control.finish(ZERO_ADDRESS)


@pytest.mark.parametrize("service", ["start", "restart", "resume", "finish", "read"])
async def test_what_is_no_address_is_an_error_reply(control: Control, service: str) -> None:
    requests = {"finish": FinishLiability("the kitchen", True), "read": ReadLiability("the kitchen")}
    with pytest.raises(ServiceFailed, match="'the kitchen' is not an address"):
        await control.ask(service, requests.get(service, StartLiability("the kitchen")))


async def test_an_agent_without_executor_offers_only_to_read(place: Place) -> None:
    async with controlled(place, place.agent("robot", enable_executor=False)) as control:
        assert await control.read(ZERO_ADDRESS) == LiabilityRead(False)
        with pytest.raises(ServiceFailed, match="no agent answers"):
            await control.start(ZERO_ADDRESS)

"""Requests that the services of an agent refuse, and the reasons."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from mesh.agent.ledger import Phase, WrongPhase
from mesh.network import ServiceFailed
from schemas import ZERO_ADDRESS, cid_of_bytes
from schemas.rpc import Done, FinishLiability, LiabilityRead, LiabilityRequest
from tests.support.agent.controls import Control, control, controlled, ready
from tests.support.market import in_phase, offering_unseen

if TYPE_CHECKING:
    from mesh.agent.agent import Agent
    from tests.support.market import Place

__all__ = ["control"]


def not_done(address: str, asked: str, phase: Phase | None) -> Done:
    """The reply to a request that the phase of the job does not allow."""
    return Done(False, str(WrongPhase(address, asked=asked, phase=phase)))


async def test_a_request_that_the_phase_does_not_allow_is_answered_with_the_reason(
    place: Place, control: Control, person: Agent
) -> None:
    contract = await ready(control, person, place)
    address = contract.address
    await control.start(address)
    assert await control.start(address) == not_done(address, "start", Phase.RUNNING)
    resumed = await control.ask("resume", LiabilityRequest(address))
    assert resumed == not_done(address, "resume", Phase.RUNNING)
    await control.finish(address)
    with pytest.raises(ServiceFailed) as caught:
        await control.finish(address)
    assert (caught.value.service, caught.value.reason) == ("finish", "agent-error")
    for service, request in (("start", LiabilityRequest), ("restart", LiabilityRequest), ("resume", LiabilityRequest)):
        done = await control.ask(service, request(address))
        assert not done.success
        assert done.msg.startswith(f"can't {service} {address}: it is ")


async def test_a_job_whose_objective_was_not_fetched_can_not_be_started(place: Place) -> None:
    robot = offering_unseen(place.agent("robot", fetch_timeout=30.0))
    async with controlled(place, robot) as control, place.agent("person") as person:
        contract = await person.demand(cid_of_bytes(b"nobody's"))
        await in_phase(robot, contract, Phase.INCOMING)
        done = await control.start(contract.address)
        assert done == not_done(contract.address, "start", Phase.INCOMING)
        await control.finish(contract.address, success=False)
        assert not (await contract.outcome()).success


async def test_an_unknown_liability_is_not_a_job(control: Control) -> None:
    done = await control.start(ZERO_ADDRESS)
    assert done == not_done(ZERO_ADDRESS, "start", None)
    assert await control.read(ZERO_ADDRESS) == LiabilityRead(False)
    with pytest.raises(ServiceFailed) as caught:
        await control.finish(ZERO_ADDRESS)
    assert (caught.value.service, caught.value.reason) == ("finish", "agent-error")
    assert "is not a job of this agent" in str(caught.value), "the caller gets only the sentence"


@pytest.mark.parametrize("service", ["start", "restart", "resume", "finish", "read"])
async def test_an_invalid_address_is_an_error_reply(control: Control, service: str) -> None:
    requests = {"finish": FinishLiability("the kitchen", True), "read": LiabilityRequest("the kitchen")}
    with pytest.raises(ServiceFailed) as caught:
        await control.ask(service, requests.get(service, LiabilityRequest("the kitchen")))
    assert (caught.value.service, caught.value.reason) == (service, "agent-error")
    assert "'the kitchen' is not an address" in str(caught.value), "the caller gets only the sentence"


async def test_an_agent_without_executor_offers_only_to_read(place: Place) -> None:
    async with controlled(place, place.agent("robot", enable_executor=False)) as control:
        assert await control.read(ZERO_ADDRESS) == LiabilityRead(False)
        with pytest.raises(ServiceFailed) as caught:
            await control.start(ZERO_ADDRESS)
    assert (caught.value.service, caught.value.reason) == ("start", "no-agent")

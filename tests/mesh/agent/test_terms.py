"""What programs give as terms: amounts with units, files by their path; and how orders and contracts print."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING, Any

import pytest

from mesh import InputError
from mesh.agent.contracts import Contract, Outcome
from mesh.agent.handlers import Job
from mesh.agent.objectives import ObjectiveUnfit
from mesh.agent.orders import OrderState
from mesh.agent.trade import Order
from schemas import Empty, cid_of_file, message_hash
from tests.support.agent.samples import liability
from tests.support.objectives import objective
from tests.support.orders import demand, verified_demand
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    from mesh import Agent
    from tests.support.market import Place


@pytest.fixture
def blink(place: Place) -> Path:
    return place.save(objective(("/blink", Empty())))


async def test_an_order_takes_amounts_as_texts_and_a_path_as_text(blink: Path, person: Agent) -> None:
    order = await person.order(str(blink), cost="0.000001 XRT", permit_fee="2wn")
    message: Any = order.message
    assert (message.objective, message.cost, message.validator_fee) == (cid_of_file(blink), 1000, 2)
    cid = await person.add(str(blink))
    assert (await person.order(cid, cost="7 units")).message.cost == 7
    assert (await person.order(blink, cost=42)).message.cost == 42


async def test_an_offer_takes_amounts_as_texts(place: Place, blink: Path) -> None:
    async with place.agent("robot") as robot:
        await robot.offer(objective=await robot.add(blink), cost="0.000001", lighthouse_fee="0.000002 xrt")
        message: Any = robot.orders()[0].message
        assert (message.cost, message.lighthouse_fee) == (1000, 2000)


@pytest.mark.parametrize("terms", [{"cost": "5 EUR"}, {"cost": "much"}, {"cost": 1.5}, {"validator_fee": "0.1wn"}])
async def test_what_is_no_amount_is_refused(blink: Path, terms: dict[str, Any], person: Agent) -> None:
    with pytest.raises(InputError):  # an amount is wrong, or its token unknown
        await person.order(blink, **terms)


async def test_what_is_neither_cid_nor_file_is_refused(tmp_path: Path, person: Agent) -> None:
    for missing in ("blink.mcap", tmp_path / "none.mcap", tmp_path, ""):
        with raises_with(InputError, code="not-an-objective", match=re.escape(repr(str(missing)))):
            await person.order(missing)


async def test_a_file_that_no_robot_can_play_is_refused(place: Place, tmp_path: Path) -> None:
    (tmp_path / "robot.py").write_text("import this")
    async with place.agent("person") as person:
        with pytest.raises(ObjectiveUnfit) as caught:
            await person.order(str(tmp_path / "robot.py"))
        assert caught.value.reason == "not-a-recording"


async def test_a_contract_prints_its_address_state_cost_and_parties() -> None:
    def contract() -> tuple[Contract, asyncio.Future[Outcome]]:
        ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        return Contract(liability(), ended, None, None), ended  # type: ignore[arg-type]

    shown, ended = contract()
    for part in (shown.address, "open", f"cost={liability().cost}", liability().promisee, liability().promisor):
        assert part in repr(shown)
    ended.set_result(Outcome(success=True, result="Qm"))
    assert "paid" in repr(shown)
    shown, ended = contract()
    ended.set_result(Outcome(success=False, result=""))
    assert "refunded" in repr(shown)
    shown, ended = contract()
    ended.set_exception(ValueError())
    assert "reverted" in repr(shown)


def test_hashes_print_as_hexadecimal_digits() -> None:
    digest = message_hash(demand())
    assert str(digest) == repr(digest) == f"{digest}" == bytes(digest).hex()
    assert digest == bytes(digest)
    verified = verified_demand()
    assert f"hash={verified.hash.hex()}" in repr(verified)
    assert "=b'" not in repr(verified)


def test_an_outcome_prints_what_there_is_to_say() -> None:
    assert repr(Outcome(success=True, result="Qm")) == "Outcome(success=True, result='Qm')"


def test_an_order_prints_its_state_and_terms_in_one_short_line() -> None:
    said = demand()
    facts: dict[str, Any] = {"message": said, "hash": "ab" * 32, "posted": 0.0, "_traded": None, "_trader": None}
    shown = repr(Order(state=OrderState.OPEN, liability="", **facts))
    assert shown.startswith(f"Order(demand {'ab' * 32}, open, model={said.model}, ")
    shown = repr(Order(state=OrderState.MATCHED, liability="0x12", **facts))
    assert shown.endswith(f"cost={said.cost}, deadline={said.deadline}, liability=0x12)")


async def test_an_agent_and_its_job_print_what_they_are_for(place: Place) -> None:
    agent = place.agent("robot")
    assert repr(agent) == f"Agent(model={agent.model})"
    async with agent:
        assert repr(agent) == f"Agent(model={agent.model}, account={agent.address})"
    job = Job(None, place.address("robot"), liability(), position=2)  # type: ignore[arg-type]
    assert repr(job) == f"Job({liability().address}, position=2, topics=[])"

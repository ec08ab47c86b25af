"""Payments that come late, are taken back, or are asked for again after a restart."""

from __future__ import annotations

import asyncio
import os
import sqlite3
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from mesh.agent.ledger import Outgoing, Phase
from mesh.chain.liabilities import Liabilities
from mesh.recording import open_objective
from schemas import String, cid_of_bytes, cid_of_file
from tests.support.agent.restarts import COST, SAYING, WORDS, Paying, made_by_a_provider_that_leaves, paid, speaking
from tests.support.agent.samples import liability
from tests.support.market import in_phase, offering
from tests.support.orders import result
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mesh.agent.agent import Agent
    from schemas import Liability
    from tests.support.market import Place

__all__ = ["paid"]

OTHER = liability("set aside until a reorganisation brings it back").address


async def test_a_job_that_awaits_its_finish_keeps_its_recording_over_a_restart(place: Place) -> None:
    """Without handlers: the result holds the messages of the device before the restart."""
    async with place.provider(), place.agent("person") as person:
        async with offering(place.agent("robot")) as robot:
            contract = await person.demand(SAYING)
            await in_phase(robot, contract, Phase.READY)
            executor = robot.runtime.executor
            await executor.start(contract.address)
            run = executor.runs.get(contract.address)
            assert run is not None
            run.publish("/said", "before")
            await until(lambda run=run: run.position == len(WORDS))  # type: ignore[misc]
        async with place.agent("robot") as robot:
            executor = robot.runtime.executor
            await executor.resume(contract.address)
            run = executor.runs.get(contract.address)
            assert run is not None
            run.publish("/said", "after")
            await robot.finish(contract.address, success=True)
            assert (await contract.outcome()).success
            recording = open_objective(await contract.recording())
    messages = [(message.topic, String.decode(message.payload).data) for message in recording.messages()]
    assert [data for topic, data in messages if topic == "/said"] == ["before", "after"]
    assert [data for topic, data in messages if topic == "/say"] == WORDS, "nothing is played twice"


async def test_a_finished_job_is_paid_when_the_provider_starts_late(place: Place, paid: Paying) -> None:
    said: list[str] = []
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), said) as robot:
        contract = await made_by_a_provider_that_leaves(place, person, robot)
        await in_phase(robot, contract, Phase.COMPLETE)
        assert not await paid.once()
        async with place.provider():
            assert (await contract.outcome()).success
            await in_phase(robot, contract, Phase.FINALIZED)
        assert await robot.parts.ledger.outbox(head=0) == []
    assert await paid.once()


async def test_a_finished_job_is_paid_after_a_restart(place: Place, paid: Paying) -> None:
    said: list[str] = []
    async with place.agent("person") as person:
        async with speaking(offering(place.agent("robot")), said) as robot:
            contract = await made_by_a_provider_that_leaves(place, person, robot)
            await in_phase(robot, contract, Phase.COMPLETE)
        async with speaking(place.agent("robot"), said) as robot, place.provider():
            outcome = await contract.outcome()
            await in_phase(robot, contract, Phase.FINALIZED)
            recording = await contract.recording()
        assert cid_of_file(recording) == outcome.result
    assert said == WORDS, "a finished job is not done again"
    assert await paid.once()


async def test_a_result_is_out_of_the_outbox_before_its_job_is_marked_as_finalized(place: Place) -> None:
    """Otherwise a crash between the two would have the result sent for a job that is marked and skipped."""
    ours = liability(promisor=place.address("robot"))
    signed = result(liability=ours.address)

    async with place.agent("robot", enable_executor=False) as robot:
        ledger = robot.parts.ledger
        await ledger.add_job(ours)
        await ledger.complete(ours.address, success=True, result=signed.result, note="", outgoing=Outgoing.of(signed))
        refuse_to_finalize(robot.parts.directory / "ledger.sqlite")
        with pytest.raises(sqlite3.IntegrityError, match="crash"):
            await robot.runtime.finalized(ours.address, success=True, result=signed.result)
        assert await ledger.outbox(head=0) == []
        job = await ledger.job(ours.address)
        assert job is not None
        assert job.phase is Phase.COMPLETE


async def test_the_result_of_a_payment_that_was_half_handled_and_reverted_is_sent_again(
    place: Place, paid: Paying
) -> None:
    """The robot ends after it has taken the Result out of the outbox, and a reorganisation takes the payment."""
    said: list[str] = []
    async with place.agent("person") as person:
        ledger = await crashed_at(refuse_to_finalize, place, person)
        assert await paid.once()
        await place.forget_blocks(1)
        accept_changes(ledger)
        assert not await paid.once()
        async with speaking(place.agent("robot"), said), place.provider():
            await until_found(paid.once, what="the payment")
    assert said == [], "the work was done before the crash"


async def test_the_orders_of_a_contract_that_was_half_handled_and_reverted_are_sent_again(
    place: Place, paid: Paying
) -> None:
    """The robot ends after it has taken its offer out of the outbox, and a reorganisation takes the contract."""
    said: list[str] = []
    async with place.agent("person") as person:
        ledger = await crashed_at(refuse_jobs, place, person)
        await place.forget_blocks(1)
        accept_changes(ledger)
        async with speaking(place.agent("robot"), said), place.provider():
            await until_found(paid.once, what="the payment")
    assert said == WORDS


async def crashed_at(refuse: Callable[[Path], None], place: Place, person: Agent) -> Path:
    """A robot does a job until its ledger refuses a change; the path of that ledger."""
    ledgers: list[Path] = []

    async def work() -> None:
        async with speaking(offering(place.agent("robot")), []) as robot, place.provider():
            ledgers.append(robot.parts.directory / "ledger.sqlite")
            refuse(*ledgers)
            await person.order(SAYING, cost=COST)  # `demand` would withdraw it when it is cancelled
            await asyncio.sleep(60)

    with pytest.raises(sqlite3.IntegrityError):
        await work()
    return ledgers[0]


async def test_the_result_of_a_reverted_payment_is_sent_again(place: Place, paid: Paying) -> None:
    said: list[str] = []
    async with place.agent("person") as person, speaking(offering(place.agent("robot")), said) as robot:
        async with place.provider():
            contract = await person.demand(SAYING, cost=COST)
            await in_phase(robot, contract, Phase.FINALIZED)
            assert await paid.once()
        await place.forget_blocks(1)
        assert not await paid.once()
        await in_phase(robot, contract, Phase.COMPLETE)
        job = await robot.parts.ledger.job(contract.address)
        assert job is not None
        assert contract.address in robot.parts.store.pins().get(job.result or "", ()), "its recording may be evicted"
        async with place.provider():
            await in_phase(robot, contract, Phase.FINALIZED)
        assert await robot.parts.ledger.outbox(head=0) == []
    assert await paid.once()
    assert said == WORDS


async def test_the_files_of_jobs_that_are_gone_may_be_evicted_after_a_restart_but_no_others(place: Place) -> None:
    cid, gone = cid_of_bytes(b"a file"), liability("of a job that a crash has cut off").address
    async with place.agent("robot") as robot:
        for label in (gone, "0x-mine", "mine"):
            robot.parts.store.pin(cid, label)
    async with place.agent("robot") as robot:
        await until(lambda: gone not in robot.parts.store.pins()[cid])
        assert robot.parts.store.pins()[cid] == {"0x-mine", "mine"}


async def test_a_finalization_without_a_result_is_not_reverted(place: Place) -> None:
    ours = liability(promisor=place.address("robot"))
    async with place.agent("robot") as robot:
        await robot.parts.ledger.add_job(ours)
        await robot.parts.ledger.set_phase(ours.address, Phase.FINALIZED)
        await robot.runtime.finalization_reverted(ours.address)
        await robot.runtime.finalization_reverted(liability("of somebody else").address)
        assert [job.phase for job in await robot.parts.ledger.jobs(Phase)] == [Phase.FINALIZED]
        assert await robot.parts.ledger.outbox(head=0) == []


async def test_a_job_whose_contract_comes_back_finalized_is_finalized(place: Place) -> None:
    """A reorganisation takes the contract, and the new blocks have it together with its end."""
    ours = liability(promisor=place.address("robot"))
    async with place.agent("robot") as robot:
        ledger, listener = robot.parts.ledger, robot.runtime
        await ledger.add_job(ours)
        await ledger.set_phase(ours.address, Phase.COMPLETE)
        await listener.liability_reverted(ours.address)
        assert await ledger.job(ours.address) is None
        ended = replace(ours, is_finalized=True, is_success=True)
        await listener.new_liability(ended, demand_hash=b"d" * 32, offer_hash=b"o" * 32)
        job = await ledger.job(ours.address)
        assert job is not None
        assert job.phase is Phase.FINALIZED
        unknown = replace(ended, address=liability("of another chain").address)
        await listener.new_liability(unknown, demand_hash=b"d" * 32, offer_hash=b"o" * 32)
        assert await ledger.job(unknown.address) is None


async def test_a_contract_created_again_at_another_address_is_paid_once(place: Place, paid: Paying) -> None:
    """A reorganisation took the contract; the provider makes it again of the same orders, at another address."""
    said: list[str] = []
    async with place.agent("person") as person, place.provider():
        async with offering(place.agent("robot")) as robot:
            contract = await person.demand(SAYING, cost=COST)
            first = contract.address
            await in_phase(robot, contract, Phase.READY)
            await place.forget_blocks(1)
            await until(lambda: contract.address != first)
            await until_found(lambda: is_gone(robot, first), what="the end of the job of the first contract")
            await in_phase(robot, contract, Phase.READY)
        async with speaking(place.agent("robot"), said) as robot:
            assert (await contract.outcome()).success
            await in_phase(robot, contract, Phase.FINALIZED)
    assert said == WORDS
    assert await paid.once()


async def is_gone(robot: Agent, address: str) -> bool:
    return await robot.parts.ledger.job(address) is None


async def test_a_contract_that_is_gone_when_it_is_read_does_not_stop_the_reading(
    place: Place, paid: Paying, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reorganisation took it after its event was read; the provider makes it again at another address."""
    said: list[str] = []
    get, gone = Liabilities.get_with_orders, list[str]()

    async def get_too_late(liabilities: Liabilities, address: str) -> tuple[Liability, tuple[bytes, bytes]]:
        if not gone and liabilities._contracts.own_address == place.address("robot"):
            gone.append(address)
            await place.forget_blocks(1)
        return await get(liabilities, address)

    monkeypatch.setattr(Liabilities, "get_with_orders", get_too_late)
    async with place.agent("person") as person, place.provider(), speaking(offering(place.agent("robot")), said):
        await person.demand(SAYING, cost=COST)
        await until_found(paid.once, what="the payment")
    assert gone
    assert said == WORDS


async def test_no_recording_of_an_ended_job_is_left(place: Place) -> None:
    """Neither of one that was refunded while it ran, nor of one whose robot crashed before it could delete it."""
    said: list[str] = []
    async with place.provider(), place.agent("person") as person:
        async with speaking(offering(place.agent("robot")), said, stuck_at="0") as robot:
            contract = await person.demand(SAYING)
            await in_phase(robot, contract, Phase.RUNNING)
            recordings = robot.parts.recordings
            assert os.listdir(recordings) == [f"{contract.address}.mcap.part"]
            failed = result(signer=robot.parts.signer, liability=contract.address, success=False)
            await place.chains["provider"].liabilities.finalize(place.market.deployment.lighthouse_name, failed)
            await in_phase(robot, contract, Phase.FINALIZED)
            await until(lambda: os.listdir(recordings) == [])
        (recordings / f"{contract.address}.mcap").touch()
        waiting = recordings / f"{OTHER}.mcap"
        waiting.touch()
        async with place.agent("robot"):
            await until(lambda: os.listdir(recordings) == [waiting.name])


def refuse_jobs(ledger: Path) -> None:
    """Have SQLite fail when a job is added."""
    database = sqlite3.connect(ledger)
    database.execute("CREATE TRIGGER crash BEFORE INSERT ON jobs BEGIN SELECT RAISE(ABORT, 'crash'); END")
    database.close()


def accept_changes(ledger: Path) -> None:
    database = sqlite3.connect(ledger)
    database.execute("DROP TRIGGER crash")
    database.close()


def refuse_to_finalize(ledger: Path) -> None:
    """Have SQLite fail when a job is marked, as a full disk or a crash would."""
    database = sqlite3.connect(ledger)
    database.execute(
        "CREATE TRIGGER crash BEFORE UPDATE ON jobs WHEN NEW.phase = 'finalized'"
        " BEGIN SELECT RAISE(ABORT, 'crash'); END"
    )
    database.close()

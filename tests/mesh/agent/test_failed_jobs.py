"""Jobs that fail: refused objectives, failing handlers, an unusable ledger, and what is reported."""

from __future__ import annotations

import asyncio
import logging
import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh import Agent, Settings
from mesh.agent.handlers import JobFailed
from mesh.agent.ledger import Phase
from mesh.base.database import LedgerUnusable
from mesh.role.running import cause_of
from mesh.testing import Market, assert_paid, assert_refunded
from schemas import Empty, cid_of_bytes
from tests.support.agent.restarts import COST, notes
from tests.support.agent.trades import doing_nothing
from tests.support.market import MODEL, Place, offering, offering_unseen
from tests.support.objectives import objective

if TYPE_CHECKING:
    from mesh.agent.agent import Messages
    from mesh.agent.handlers import Job


class Speed(msgspec.Struct):
    """What a handler asks for."""

    wheel: int


async def refusal(market: Market, robot: Agent, content: Messages | str | Path) -> tuple[str, str]:
    """Have a robot fail at an objective: its note in the ledger and in the recording. The money must come back."""
    async with market.robot(robot):
        person = await market.person()
        before = await market.balance(robot), await market.balance(person)
        source = await person.add(content) if isinstance(content, Path) else content
        contract = await market.demand(MODEL, source, by=person, cost=COST)
        outcome = await market.outcome(contract)
        assert_refunded(outcome)
        assert outcome.reason
        assert outcome.code
        assert (await market.balance(robot), await market.balance(person)) == before
        job = await robot.parts.ledger.job(contract.address)
        assert job is not None
        assert job.success is False
    assert job.note == f"{outcome.reason} [{outcome.code}]"
    return job.note, "\n".join(notes(outcome))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (JobFailed("the lamp is broken"), "the lamp is broken [job-failed]"),
        (ValueError("no lamp"), "ValueError: no lamp [handler-failed]"),
    ],
    ids=["JobFailed", "ValueError"],
)
async def test_a_handler_that_raises_fails_its_job_and_the_promisee_is_refunded(
    market: Market, error: Exception, said: str
) -> None:
    robot = offering(Agent(MODEL))
    calls = 0

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        nonlocal calls
        calls += 1
        raise error

    note, recorded_note = await refusal(market, robot, [("/go", Empty()), ("/go", Empty())])
    assert note == recorded_note == said
    assert calls == 1


async def test_a_handler_whose_inner_task_was_cancelled_has_not_done_its_job(market: Market) -> None:
    robot = offering(Agent(MODEL))

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        inner = asyncio.create_task(asyncio.sleep(60))
        inner.cancel()
        await inner

    note, _ = await refusal(market, robot, [("/go", Empty())])
    assert note == "the handler of /go was cancelled [handler-cancelled]"


async def test_a_message_of_another_type_than_the_handlers_is_refused_before_anything_is_played(market: Market) -> None:
    robot = offering_unseen(Agent(MODEL))
    speeds: list[Speed] = []

    @robot.on("/go", Speed)
    async def go(job: Job, message: Speed) -> None:
        speeds.append(message)

    note, _ = await refusal(market, robot, [("/go", Speed(3)), ("/go", {"wheel": "fast"})])
    assert "(unfit-message): message 1 on /go: not a Speed" in note
    assert speeds == []


async def test_a_topic_without_handler_is_refused_before_anything_is_played(market: Market) -> None:
    robot = offering_unseen(Agent(MODEL))
    done: list[object] = []

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        done.append(message)

    note, _ = await refusal(market, robot, [("/go", Empty()), ("/fly", Empty())])
    assert "unknown-topic" in note
    assert "/fly" in note
    assert done == []


async def test_a_file_that_is_not_a_recording_is_refused(market: Market, tmp_path: Path) -> None:
    (tmp_path / "objective.mcap").write_bytes(b"please go to the kitchen\n")
    robot = doing_nothing(offering_unseen(Agent(MODEL)))
    note, _ = await refusal(market, robot, tmp_path / "objective.mcap")
    assert "not-a-recording" in note


async def test_a_job_whose_objective_is_unavailable_fails_and_is_refunded(market: Market) -> None:
    robot = doing_nothing(offering_unseen(Agent(MODEL, settings=Settings(fetch_timeout=0.2))))
    note, _ = await refusal(market, robot, cid_of_bytes(b"held by nobody"))
    assert "is not available" in note


async def test_an_objective_over_the_size_limit_is_refused(market: Market) -> None:
    robot = doing_nothing(offering_unseen(Agent(MODEL, settings=Settings(objective_size_limit=2000))))
    note, _ = await refusal(market, robot, [("/blob", os.urandom(4000))])
    assert "2000 allowed" in note


async def test_a_job_whose_objective_is_missing_does_not_hold_up_the_next(market: Market) -> None:
    robot = doing_nothing(offering_unseen(Agent(MODEL, settings=Settings(fetch_timeout=120.0))))
    async with market.robot(robot):
        missing = await market.demand(MODEL, cid_of_bytes(b"nobody has this"))
        assert_paid(await market.order(MODEL, [("/go", Empty())]))
        job = await robot.parts.ledger.job(missing.address)
        assert job is not None
        assert job.phase is Phase.INCOMING


async def test_a_job_failed_by_its_handler_is_logged_without_a_traceback(
    market: Market, caplog: pytest.LogCaptureFixture
) -> None:
    robot = offering(Agent(MODEL))

    @robot.on("/go")
    async def go(job: Job, message: Any) -> None:
        raise JobFailed("the battery is empty")

    with caplog.at_level(logging.WARNING, "mesh.agent"):
        async with market.robot(robot):
            await market.order(MODEL, [("/go", Empty())])
    (record,) = [record for record in caplog.records if vars(record).get("event") == "job-failed"]
    assert vars(record)["facts"] == {"code": "job-failed"}
    assert "the battery is empty" in record.getMessage()
    assert not record.exc_info


def refuse_changes_of_jobs(ledger: Path) -> None:
    """Have every change of a job fail as on a full disk: its trigger needs a table that does not exist."""
    with closing(sqlite3.connect(ledger)) as database:
        database.execute("CREATE TRIGGER full_disk BEFORE UPDATE ON jobs BEGIN INSERT INTO room VALUES (1); END")


def accept_changes_of_jobs(ledger: Path) -> None:
    with closing(sqlite3.connect(ledger)) as database:
        database.execute("DROP TRIGGER full_disk")


async def test_a_ledger_that_can_not_be_written_ends_the_agent_and_fails_no_job(place: Place) -> None:
    """As on a full disk: when there is room again, the restarted agent goes on with the job."""
    done: list[str] = []
    ledgers: list[Path] = []
    before = await place.chains["person"].block_number()

    def robot() -> Agent:
        made = offering(place.agent("robot"))

        @made.on("/go")
        async def go(job: Job, message: Any) -> None:
            if not done:
                ledgers.append(made.parts.directory / "ledger.sqlite")
                refuse_changes_of_jobs(*ledgers)
            done.append(message.data)

        return made

    async with place.provider(), place.agent("person") as person:

        async def asked(robot: Agent) -> None:
            async with robot:
                await (await person.demand(place.save(objective(("/go", "there"))))).outcome()

        with pytest.raises(ExceptionGroup) as caught:
            await asyncio.wait_for(asked(robot()), 30)
        assert isinstance(cause_of(caught.value), LedgerUnusable), "one line, and no traceback"
        accept_changes_of_jobs(*ledgers)
        (made,) = await place.chains["person"].liabilities.list(promisee=place.address("person"), from_block=before)
        async with robot():
            assert (await asyncio.wait_for((await person.contract(made.address)).outcome(), 30)).success
    assert set(done) == {"there"}

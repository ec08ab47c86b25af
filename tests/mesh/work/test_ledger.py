"""The ledger: what an agent has done, it remembers."""

from __future__ import annotations

import asyncio
import sqlite3
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest

from mesh.errors import ClosedError, ConfigurationError
from mesh.work import Ledger, Phase
from mesh.work import ledger as ledger_module
from mesh.work.ledger import VERSION, LedgerUnusable
from mesh.work.outbox import outgoing
from schemas import cid_of_bytes
from tests.mesh.work.samples import liability, message
from tests.support.disks import room_for
from tests.support.orders import demand
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

RESULT = cid_of_bytes(b"a recording")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "ledger.sqlite"


@pytest.fixture
async def ledger(path: Path) -> AsyncIterator[Ledger]:
    async with Ledger(path) as opened:
        yield opened


async def test_a_new_job_is_incoming_and_holds_the_record(ledger: Ledger) -> None:
    assert await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.liability, job.phase, job.success, job.result, job.position, job.note) == (
        liability(),
        Phase.INCOMING,
        None,
        None,
        0,
        "",
    )


async def test_unknown_jobs_are_none(ledger: Ledger) -> None:
    assert await ledger.job(liability().address) is None


async def test_adding_a_known_job_changes_nothing(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    assert not await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.RUNNING, 7)


async def test_a_phase_without_position_keeps_the_position(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    await ledger.set_phase(liability().address, Phase.READY)
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.READY, 7)


async def test_a_position_keeps_the_phase(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.COMPLETE)
    await ledger.set_position(liability().address, 3)
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.COMPLETE, 3)


async def test_a_job_set_aside_is_unknown_until_it_is_added_again_with_all_that_was(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.set_phase(liability().address, Phase.RUNNING, position=7)
    await ledger.set_aside(liability().address)
    assert await ledger.job(liability().address) is None
    assert await ledger.jobs() == []
    assert await ledger.add_job(liability())
    assert not await ledger.add_job(liability())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.position) == (Phase.RUNNING, 7)


async def test_jobs_are_listed_by_phase_oldest_first(ledger: Ledger) -> None:
    for name in ("c", "a", "b", "done"):
        await ledger.add_job(liability(name))
    await ledger.set_phase(liability("done").address, Phase.FINALIZED)
    await ledger.set_phase(liability("a").address, Phase.READY)
    assert [job.liability for job in await ledger.jobs()] == [liability("c"), liability("a"), liability("b")]
    assert [job.liability for job in await ledger.jobs((Phase.READY,))] == [liability("a")]
    assert await ledger.jobs(()) == []


async def test_completing_writes_the_end_and_the_result_to_be_sent(ledger: Ledger) -> None:
    await ledger.add_job(liability())
    await ledger.complete(liability().address, success=False, result=RESULT, note="why", outgoing=message())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.success, job.result, job.note) == (Phase.COMPLETE, False, RESULT, "why")
    assert await ledger.outbox(head=0) == [message()]


async def test_completing_writes_both_or_neither(ledger: Ledger, path: Path) -> None:
    await ledger.add_job(liability())
    with sqlite3.connect(path) as other:
        other.execute("CREATE TRIGGER full BEFORE INSERT ON outbox BEGIN SELECT RAISE(ABORT, 'disk full'); END")
    other.close()
    with pytest.raises(sqlite3.IntegrityError, match="disk full"):
        await ledger.complete(liability().address, success=True, result=RESULT, note="", outgoing=message())
    job = await ledger.job(liability().address)
    assert job is not None
    assert (job.phase, job.result) == (Phase.INCOMING, None)
    assert await ledger.outbox(head=0) == []


async def test_cancelling_a_completion_leaves_both_or_neither_and_later_writes_stay(path: Path) -> None:
    """Wherever the cancellation strikes: the steps of the transaction go through the ledger's thread one by one."""
    for steps in range(15):
        name = f"job {steps}"
        async with Ledger(path) as ledger:
            await ledger.add_job(liability(name))
            completing = asyncio.create_task(
                ledger.complete(
                    liability(name).address, success=True, result=RESULT, note="", outgoing=message(f"of {name}")
                )
            )
            await asyncio.sleep(steps * 0.0002)
            completing.cancel()
            await asyncio.wait([completing])
            await ledger.set_cursor("after", steps)
        async with Ledger(path) as ledger:
            job = await ledger.job(liability(name).address)
            assert job is not None
            sent = [waiting.identity for waiting in await ledger.outbox(head=0)]
            assert (job.phase is Phase.COMPLETE) == (f"of {name}" in sent)
            assert await ledger.cursor("after") == steps


async def test_concurrent_writes_do_not_end_up_in_each_others_transactions(ledger: Ledger) -> None:
    names = [str(number) for number in range(20)]
    await asyncio.gather(*(ledger.add_job(liability(name)) for name in names))
    await asyncio.gather(
        *(
            ledger.complete(liability(name).address, success=True, result=RESULT, note="", outgoing=message(name))
            for name in names
        ),
        *(ledger.set_cursor(name, 1) for name in names),
    )
    assert len(await ledger.jobs((Phase.COMPLETE,))) == 20
    assert len(await ledger.outbox(head=0)) == 20


async def test_a_message_posted_twice_is_kept_once(ledger: Ledger) -> None:
    await ledger.post(message())
    await ledger.post(message())
    assert await ledger.outbox(head=0) == [message()]


async def test_settling_takes_a_message_out_and_says_whether_it_was_there(ledger: Ledger) -> None:
    await ledger.post(message())
    assert await ledger.settle("a message")
    assert not await ledger.settle("a message")
    assert await ledger.outbox(head=0) == []


async def test_messages_go_out_in_their_order_until_their_deadline(ledger: Ledger) -> None:
    await ledger.post(message("late", deadline=11))
    await ledger.post(message("early", deadline=10))
    await ledger.post(message("never", deadline=None))
    assert [waiting.identity for waiting in await ledger.outbox(head=9)] == ["late", "early", "never"]
    assert [waiting.identity for waiting in await ledger.outbox(head=10)] == ["late", "never"]
    assert [waiting.identity for waiting in await ledger.outbox(head=0)] == ["late", "never"], "forgotten for good"


async def test_cursors_are_kept_by_name(ledger: Ledger) -> None:
    assert await ledger.cursor("listener") is None
    await ledger.set_cursor("listener", 41)
    await ledger.set_cursor("listener", 42)
    await ledger.set_cursor("other", 1)
    assert await ledger.cursor("listener") == 42


async def test_what_is_remembered_of_the_chain_is_kept_with_the_cursor(ledger: Ledger) -> None:
    assert await ledger.history("listener") == b""
    await ledger.set_cursor("listener", 41)
    assert await ledger.history("listener") == b""
    await ledger.set_cursor("listener", 42, history=b"blocks")
    assert (await ledger.cursor("listener"), await ledger.history("listener")) == (42, b"blocks")


async def test_everything_survives_reopening(path: Path) -> None:
    async with Ledger(path) as ledger:
        await ledger.add_job(liability())
        await ledger.complete(liability().address, success=True, result=RESULT, note="", outgoing=message())
        await ledger.set_cursor("listener", 42)
    async with Ledger(path) as ledger:
        assert [job.result for job in await ledger.jobs()] == [RESULT]
        assert await ledger.outbox(head=0) == [message()]
        assert await ledger.cursor("listener") == 42


WRITER = """
import asyncio, sys
from pathlib import Path
from mesh.work import Ledger
async def main():
    async with Ledger(Path(sys.argv[1])) as ledger:
        for block in range(10**6):
            await ledger.set_cursor("listener", block)
            print(block, flush=True)
asyncio.run(main())
"""


def write_until_killed(path: Path) -> int:
    """The last block that a process has told of having written, before SIGKILL."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process, process.stdout as told:
        blocks = [told.readline() for _ in range(50)]
        process.kill()
        return int([*blocks, *told.read().splitlines()][-1])


async def test_what_was_written_survives_a_kill(path: Path) -> None:
    last = await asyncio.to_thread(write_until_killed, path)
    async with Ledger(path) as ledger:
        cursor = await ledger.cursor("listener")
    assert cursor is not None
    assert cursor >= last


def mark_as_version(path: Path, version: int) -> None:
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version = {version}")
    database.close()


def version_of(path: Path) -> int:
    database = sqlite3.connect(path)
    version: int = database.execute("PRAGMA user_version").fetchone()[0]
    database.close()
    return version


async def test_a_ledger_of_a_newer_version_is_refused_and_not_touched(path: Path) -> None:
    async with Ledger(path):
        pass
    mark_as_version(path, VERSION + 1)
    error = await refused(path)
    assert "was written by a newer version (format 2, this one knows 1)" in str(error)
    assert error.hint == "upgrade aira-mesh"
    assert version_of(path) == VERSION + 1


async def refused(path: Path) -> ConfigurationError:
    before = set(threading.enumerate())
    with pytest.raises(ConfigurationError) as caught:
        async with Ledger(path):
            pass
    # One that is left behind would keep the interpreter alive.
    await until(lambda: set(threading.enumerate()) <= before)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.fixture
def no_database(path: Path) -> Path:
    path.parent.mkdir()
    path.write_bytes(b"dear diary, " * 100)
    return path


@pytest.fixture
def no_file(path: Path) -> Path:
    path.mkdir(parents=True)
    return path


async def test_a_file_that_is_no_database_is_one_clear_line(no_database: Path) -> None:
    error = await refused(no_database)
    assert str(error) == f"can't use the ledger {no_database}: file is not a database"
    assert error.hint


async def test_a_folder_in_the_files_place_is_one_clear_line(no_file: Path) -> None:
    assert str(await refused(no_file)) == f"can't use the ledger {no_file}: unable to open database file"


async def test_a_folder_that_can_not_be_made_is_one_clear_line(no_database: Path) -> None:
    assert str(no_database) in str(await refused(no_database / "ledger.sqlite"))


async def test_a_closed_ledger_says_so(path: Path) -> None:
    ledger = Ledger(path)
    with pytest.raises(ClosedError):
        await ledger.cursor("listener")
    async with ledger:
        with pytest.raises(ClosedError, match="open already"):
            await ledger.__aenter__()
        await ledger.set_cursor("listener", 1)
    with pytest.raises(ClosedError):
        await ledger.add_job(liability())


async def test_an_order_that_became_a_contract_is_kept_for_when_it_did_not(ledger: Ledger) -> None:
    one, other = outgoing(demand(deadline=50)), outgoing(demand())
    for order in (one, other):
        await ledger.post(order)
    await ledger.spend(one.identity, "0xA")
    assert await ledger.outbox(head=0) == [other]

    assert not await ledger.unspend("0xB")
    assert await ledger.unspend("0xA")
    assert await ledger.outbox(head=0) == [other, one]
    assert not await ledger.unspend("0xA")
    assert await ledger.outbox(head=50) == [other], "and it has its deadline as before"


async def test_only_the_latest_orders_are_kept(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_module, "SPENT_KEPT", 2)
    orders = [outgoing(demand()) for _ in range(4)]
    for number, order in enumerate(orders):
        await ledger.post(order)
        await ledger.spend(order.identity, f"0x{number}")
    assert [await ledger.unspend(f"0x{number}") for number in range(4)] == [False, False, True, True]


async def test_what_is_not_in_the_outbox_is_not_spent(ledger: Ledger) -> None:
    await ledger.spend("an order of before", "0xA")
    assert not await ledger.unspend("0xA")


async def test_a_full_disk_is_one_clear_line_and_nothing_is_half_written(ledger: Ledger, path: Path) -> None:
    await ledger.add_job(liability())
    address, signed = liability().address, message()
    room = path.with_name(path.name + "-wal").stat().st_size
    with room_for(room):
        with pytest.raises(LedgerUnusable, match=f"^can't use the ledger {path}: ") as caught:
            await ledger.set_phase(address, Phase.READY)
        with pytest.raises(LedgerUnusable):
            await ledger.complete(address, success=True, result=RESULT, note="", outgoing=signed)
    assert "make room" in caught.value.hint
    job = await ledger.job(address)
    assert job is not None
    assert (job.phase, await ledger.outbox(head=0)) == (Phase.INCOMING, [])
    await ledger.complete(address, success=True, result=RESULT, note="", outgoing=signed)
    assert await ledger.outbox(head=0) == [signed]

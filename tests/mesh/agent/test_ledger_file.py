"""The ledger's file: it survives a kill, and an unusable file is an error."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

import pytest

from mesh.agent.ledger import Ledger, Phase
from mesh.base.database import VERSION, LedgerUnusable
from mesh.errors import ClosedError, ConfigurationError
from tests.support.agent.ledgers import RESULT, ledger, mark_as_version, path
from tests.support.agent.samples import liability, message
from tests.support.disks import file_size_limit, synced
from tests.support.waiting import until

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from pathlib import Path

__all__ = ["ledger", "path", "synced"]


async def test_everything_survives_reopening(path: Path) -> None:
    async with Ledger(path) as ledger:
        await ledger.add_job(liability())
        await ledger.complete(liability().address, success=True, result=RESULT, note="", outgoing=message())
        await ledger.set_cursor(42)
    async with Ledger(path) as ledger:
        assert [job.result for job in await ledger.jobs()] == [RESULT]
        assert await ledger.outbox(head=0) == [message()]
        assert (await ledger.cursor())[0] == 42


async def test_what_another_program_wrote_is_on_the_disk_before_it_is_read(path: Path, synced: list[str]) -> None:
    """Otherwise a power failure could take back an order that both programs have sent."""
    async with Ledger(path) as one, Ledger(path) as other:
        assert not await one.jobs()
        synced.clear()
        await one.add_job(liability())
        assert await one.jobs()
        assert synced == []
        assert await other.jobs()
        assert await other.jobs()
        assert synced == ["ledger.sqlite-wal"]


WRITER = """
import asyncio, sys
from pathlib import Path
from mesh.agent.ledger import Ledger
async def main():
    async with Ledger(Path(sys.argv[1])) as ledger:
        for block in range(10**6):
            await ledger.set_cursor(block)
            print(block, flush=True)
asyncio.run(main())
"""


def write_until_killed(path: Path) -> int:
    """The last block that a process reported as written before SIGKILL."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process, process.stdout as output:
        blocks = [output.readline() for _ in range(50)]
        process.kill()
        return int([*blocks, *output.read().splitlines()][-1])


async def test_written_rows_survive_a_kill(path: Path) -> None:
    last = await asyncio.to_thread(write_until_killed, path)
    async with Ledger(path) as ledger:
        cursor = (await ledger.cursor())[0]
    assert cursor is not None
    assert cursor >= last


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
    assert error.code == "state-too-new"
    assert f"format {VERSION + 1}, this one knows {VERSION}" in str(error)
    assert error.hint
    assert version_of(path) == VERSION + 1


def own_threads() -> set[threading.Thread]:
    """All threads but those of the event loop's pool, which end with the loop."""
    return {thread for thread in threading.enumerate() if not thread.name.startswith("asyncio_")}


async def refused(path: Path) -> ConfigurationError:
    before = own_threads()
    with pytest.raises(ConfigurationError) as caught:
        async with Ledger(path):
            pass
    # One that is left behind would keep the interpreter alive.
    await until(lambda: own_threads() <= before)
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


async def test_a_file_that_is_not_a_database_is_an_error(no_database: Path) -> None:
    error = await refused(no_database)
    assert isinstance(error, LedgerUnusable)
    assert (error.code, error.path, error.why) == ("ledger-unusable", no_database, "file is not a database")
    assert str(no_database) in str(error)
    assert error.hint


async def test_a_folder_at_the_path_of_the_ledger_is_an_error(no_file: Path) -> None:
    error = await refused(no_file)
    assert isinstance(error, LedgerUnusable)
    assert (error.code, error.path, error.why) == ("ledger-unusable", no_file, "Is a directory")


async def test_a_folder_that_can_not_be_created_is_an_error(no_database: Path) -> None:
    error = await refused(no_database / "ledger.sqlite")
    assert isinstance(error, LedgerUnusable)
    assert (error.code, error.path) == ("ledger-unusable", no_database / "ledger.sqlite")
    assert str(no_database) in str(error)


async def test_a_closed_ledger_raises(path: Path) -> None:
    ledger = Ledger(path)
    with pytest.raises(ClosedError):
        (await ledger.cursor())[0]
    async with ledger:
        with pytest.raises(ClosedError):
            await ledger.__aenter__()
        await ledger.set_cursor(1)
    with pytest.raises(ClosedError):
        await ledger.add_job(liability())


async def test_a_full_disk_is_an_error_and_nothing_is_half_written(ledger: Ledger, path: Path) -> None:
    await ledger.add_job(liability())
    address, signed = liability().address, message()
    room = path.with_name(path.name + "-wal").stat().st_size
    with file_size_limit(room):
        with pytest.raises(LedgerUnusable) as caught:
            await ledger.set_phase(address, Phase.READY)
        with pytest.raises(LedgerUnusable):
            await ledger.complete(address, success=True, result=RESULT, note="", outgoing=signed)
    assert (caught.value.code, caught.value.path) == ("ledger-unusable", path)
    job = await ledger.job(address)
    assert job is not None
    assert (job.phase, await ledger.outbox(head=0)) == (Phase.INCOMING, [])
    await ledger.complete(address, success=True, result=RESULT, note="", outgoing=signed)
    assert await ledger.outbox(head=0) == [signed]


async def test_what_is_not_synced_is_not_read(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Result that was read, and sent, before the disk refused it would be one that the ledger does not know."""
    await ledger.add_job(liability())
    reached, held = threading.Event(), threading.Event()

    def refuse(descriptor: int) -> None:
        reached.set()
        assert held.wait(30)
        raise OSError(errno.EIO, "the disk is broken")

    with monkeypatch.context() as broken:
        broken.setattr(os, "fsync", refuse)
        async with asyncio.TaskGroup() as tasks:
            completing = tasks.create_task(completed(ledger))
            await asyncio.to_thread(reached.wait)
            sending = tasks.create_task(until_readable(ledger))
            await asyncio.wait([sending], timeout=0.2)
            assert not sending.done()
            held.set()
            assert isinstance(await completing, LedgerUnusable)
            assert isinstance(await sending, LedgerUnusable)
    assert not await completed(ledger)
    assert sum((await ledger.waiting_by_kind(head=0)).values()) == 1


POSTER = """
import asyncio, os, signal, sys
from pathlib import Path
from mesh.agent.ledger import Ledger, Outgoing
async def main():
    async with Ledger(Path(sys.argv[1])) as ledger:
        os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)
        await ledger.post(Outgoing("order", "demand", b"", None))
asyncio.run(main())
"""


async def test_what_a_killed_process_did_not_sync_is_synced_before_it_is_read(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An order that was read, and sent, before a power loss takes it would be one that the ledger does not know."""
    killed = await asyncio.to_thread(subprocess.run, [sys.executable, "-c", POSTER, str(path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    fsync, synced = os.fsync, dict[str, int]()

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        synced[os.readlink(f"/proc/self/fd/{descriptor}")] = os.fstat(descriptor).st_size

    monkeypatch.setattr(os, "fsync", noted)
    async with Ledger(path) as ledger:
        assert [one.identity for one in await ledger.outbox(head=0)] == ["order"]
        log = path.with_name(path.name + "-wal")
        assert synced[str(log)] == log.stat().st_size > 0


async def until_readable(ledger: Ledger) -> LedgerUnusable | None:
    """Read what waits to be sent; why it could not be, if so."""
    try:
        await ledger.waiting_by_kind(head=0)
    except LedgerUnusable as error:
        return error
    return None


async def completed(ledger: Ledger) -> LedgerUnusable | None:
    """Complete the job; why it could not be done, if so."""
    try:
        await ledger.complete(liability().address, success=True, result=RESULT, note="", outgoing=message())
    except LedgerUnusable as error:
        return error
    return None


async def test_what_comes_while_the_ledger_is_closed_finds_it_closed(tmp_path: Path) -> None:
    """Calls that have begun are done first."""
    for turns in range(20):
        ledger = await Ledger(tmp_path / "ledger.db").__aenter__()
        row = ("INSERT OR REPLACE INTO outbox VALUES ('x', '', '', 1, '', 1, 0, '')", ())
        calls: list[Coroutine[Any, Any, object]] = [
            ledger._run(*row),
            ledger._run_together(row),
            ledger._rows("SELECT 1"),
        ]
        tasks = [asyncio.create_task(call) for call in calls]
        for _ in range(turns):
            await asyncio.sleep(0)
        await ledger.__aexit__()
        done = await asyncio.gather(*tasks, return_exceptions=True)
        failures = [error for error in done if isinstance(error, Exception)]
        assert [type(error) for error in failures] == [ClosedError] * len(failures)

"""Backups: their contents, also when the state changes during the backup."""

from __future__ import annotations

import asyncio
import dataclasses
import io
import itertools
import json
import os
import sqlite3
from typing import TYPE_CHECKING

import pytest

from mesh.agent.ledger import Ledger, Outgoing, Phase
from mesh.content import Store, StoreFull
from mesh.errors import ConfigurationError
from mesh.ops.state import ContentScope, back_up, examine_archive, restore, take_inventory
from mesh.ops.state import _backup as backup_module
from mesh.ops.state._archive import ArchiveInfo, new_archive
from mesh.ops.state._inventory import read_ledger
from schemas import cid_of_bytes
from tests.mesh.ops.state.conftest import ADDRESS, CHAIN, JOB, NONCE, OBJECTIVE, UNUSED, Folder, members, names_in
from tests.support.agent.samples import liability
from tests.support.disks import file_size_limit
from tests.support.orders import result
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.state._inventory import LedgerFacts

RECORDING = f"{ADDRESS}/{CHAIN}/recordings/{JOB.address}.mcap.part"


async def test_a_backup_has_the_state_and_no_key(folder: Folder, tmp_path: Path) -> None:
    done = await back_up(folder.path, tmp_path / "it", content="needed")

    found = members(tmp_path / "it")
    objective = f"{ADDRESS}/content/{cid_of_bytes(OBJECTIVE)}"
    assert list(found) == [
        "state.json",
        f"{ADDRESS}/{CHAIN}/ledger.sqlite",
        RECORDING,
        objective,
        f"{ADDRESS}/content/.pins/{cid_of_bytes(OBJECTIVE)}/{JOB.address}",
        NONCE,
        "checksums.json",
    ]
    assert found[objective] == OBJECTIVE
    assert found[RECORDING] == b"what it has said so far"
    assert not any(b"key" in data for name, data in found.items() if name != "state.json")
    assert (done.accounts, done.jobs, done.files) == ((ADDRESS,), 1, 1)
    assert done.size == (tmp_path / "it").stat().st_size
    assert (tmp_path / "it").stat().st_mode & 0o777 == 0o600


async def test_it_has_what_is_known_of_replaced_keys(folder: Folder, tmp_path: Path) -> None:
    for name in ("handovers.json", "retired.json"):
        (folder.home / name).write_text(name)
    await back_up(folder.path, tmp_path / "it", content="none")
    await restore(tmp_path / "it", tmp_path / "new")
    for name in ("handovers.json", "retired.json"):
        assert (tmp_path / "new" / ADDRESS / name).read_text() == name


@pytest.mark.parametrize(
    ("content", "held"),
    [("all", {OBJECTIVE, UNUSED}), ("needed", {OBJECTIVE}), ("none", set())],
)
async def test_content_is_included_as_requested(
    folder: Folder, tmp_path: Path, content: ContentScope, held: set[bytes]
) -> None:
    await back_up(folder.path, tmp_path / "it", content=content)
    assert {data for name, data in members(tmp_path / "it").items() if "content/Qm" in name} == held


async def test_missing_content_of_jobs_is_reported(folder: Folder, tmp_path: Path) -> None:
    missing = cid_of_bytes(b"gone")
    async with Ledger(folder.ledger) as ledger:
        await ledger.add_job(liability("two", objective=missing))
    assert missing in (await back_up(folder.path, tmp_path / "it", content="needed")).missing


async def test_damaged_content_is_left_out_and_reported(folder: Folder, tmp_path: Path) -> None:
    held = folder.home / "content" / cid_of_bytes(OBJECTIVE)
    held.chmod(0o644)
    held.write_bytes(b"What to do")
    done = await back_up(folder.path, tmp_path / "it", content="all")
    assert cid_of_bytes(OBJECTIVE) in done.missing
    assert done.files == 1


async def test_a_job_that_ends_during_the_backup_is_in_it_either_running_or_ended(
    folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never running without its recording."""
    ended = asyncio.Event()

    async def read_and_then_end(copy: Path) -> LedgerFacts:
        facts = await read_ledger(copy)
        if not ended.is_set():
            ended.set()
            await end_the_job(folder)
        return facts

    monkeypatch.setattr(backup_module, "read_ledger", read_and_then_end)
    await back_up(folder.path, tmp_path / "it", content="needed")

    (tmp_path / "ledger").write_bytes(members(tmp_path / "it")[f"{ADDRESS}/{CHAIN}/ledger.sqlite"])
    async with Ledger(tmp_path / "ledger") as ledger:
        job = await ledger.job(JOB.address)
        assert job is not None
        assert job.phase is Phase.COMPLETE
        assert [waiting.kind for waiting in await ledger.outbox(head=0)] == ["demand", "result"]


async def end_the_job(folder: Folder) -> None:
    """As an executor does: the Result first, then the recording goes."""
    signed = result(liability=JOB.address)
    async with Ledger(folder.ledger) as ledger:
        await ledger.complete(JOB.address, success=True, result=signed.result, note="", outgoing=Outgoing.of(signed))
    (folder.recordings / f"{JOB.address}.mcap.part").unlink()


async def test_jobs_that_keep_changing_are_an_error_and_leave_no_file(
    folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = itertools.count()

    async def read_without_jobs_every_second_time(copy: Path) -> LedgerFacts:
        facts = await read_ledger(copy)
        return dataclasses.replace(facts, jobs={}) if next(reads) % 2 else facts

    monkeypatch.setattr(backup_module, "read_ledger", read_without_jobs_every_second_time)
    with raises_with(ConfigurationError, code="state-changing"):
        await back_up(folder.path, tmp_path / "it", content="needed")
    assert names_in(tmp_path) == ["data"]


async def test_a_ledger_written_during_the_backup_is_consistent_in_it(folder: Folder, tmp_path: Path) -> None:
    async with Ledger(folder.ledger) as ledger:
        writing = asyncio.create_task(write_without_end(ledger))
        try:
            for number in range(5):
                await back_up(folder.path, tmp_path / f"{number}", content="none")
        finally:
            writing.cancel()
            await asyncio.wait([writing])
    counts = []
    for number in range(5):
        copy = tmp_path / f"{number}.sqlite"
        copy.write_bytes(members(tmp_path / f"{number}")[f"{ADDRESS}/{CHAIN}/ledger.sqlite"])
        async with Ledger(copy) as ledger:
            phases = await ledger.jobs_by_phase()
            waiting = sum((await ledger.waiting_by_kind(head=0)).values())
            assert phases.get("complete", 0) == waiting - 1, "a job's end and its Result are one"
            counts.append(phases.get("complete", 0))
        database = sqlite3.connect(copy)
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        database.close()
    assert counts == sorted(counts)
    assert counts[-1] > 0


async def write_without_end(ledger: Ledger) -> None:
    number = 0
    while True:
        number += 1
        job = liability(f"more {number}")
        signed = result(liability=job.address)
        await ledger.add_job(job)
        await ledger.complete(job.address, success=True, result=signed.result, note="", outgoing=Outgoing.of(signed))


async def test_a_backup_replaces_an_earlier_one_only_when_it_is_complete(folder: Folder, tmp_path: Path) -> None:
    (tmp_path / "it").write_bytes(b"the earlier one")
    folder.ledger.write_bytes(b"no ledger at all")
    with pytest.raises(ConfigurationError):
        await back_up(folder.path, tmp_path / "it", content="needed")
    assert (tmp_path / "it").read_bytes() == b"the earlier one"
    assert names_in(tmp_path) == ["data", "it"]


async def test_a_folder_without_state_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "content").mkdir()
    with raises_with(ConfigurationError, code="state-missing"):
        await back_up(tmp_path, tmp_path / "it", content="needed")


async def test_a_full_disk_is_an_error_and_leaves_no_file(folder: Folder, tmp_path: Path) -> None:
    with Store(folder.home / "content") as store:
        store.put_bytes(os.urandom(3 << 20), pin="user")
    with file_size_limit(1 << 20), pytest.raises(Exception, match=r"(full|room)"):
        await back_up(folder.path, tmp_path / "it", content="all")
    assert not (tmp_path / "it").exists()


def test_a_disk_that_is_full_at_the_end_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    """What is buffered then can't be written when the file is closed either."""
    about = ArchiveInfo(format=1, made="", software="", content="all", parts=())
    with file_size_limit(64), pytest.raises(StoreFull), new_archive(tmp_path / "it", about) as archive:
        archive.add("it", io.BytesIO(b"it"), size=2)
    assert not list(tmp_path.iterdir())


async def test_the_inventory_lists_the_state(folder: Folder) -> None:
    found = await take_inventory(folder.path)
    (account,) = found.accounts
    (chain,) = account.chains
    assert (chain.chain, chain.block, chain.jobs, chain.waiting, chain.recordings) == (CHAIN, 99, {"running": 1}, 1, 1)
    assert (account.files, account.bytes, account.pinned_bytes) == (2, len(OBJECTIVE + UNUSED), len(OBJECTIVE))
    assert (account.in_use, found.transactions) == (False, 1)


async def test_the_inventory_shows_agents_in_use(folder: Folder) -> None:
    with Store(folder.home / "content"):
        assert (await take_inventory(folder.path)).accounts[0].in_use


async def test_a_backup_describes_itself(folder: Folder, tmp_path: Path) -> None:
    await back_up(folder.path, tmp_path / "it", content="all")
    found = examine_archive(tmp_path / "it")
    assert found.files == {"content": 2, "ledgers": 1, "pins": 1, "recordings": 1, "transactions": 1}
    assert found.content == "all"
    assert json.loads(members(tmp_path / "it")["state.json"])["format"] == 1

"""Restoring a backup: what it replaces, what it refuses, and that it never leaves a part incomplete."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import sqlite3
import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mesh.agent.ledger import Ledger, Phase
from mesh.base.database import VERSION, LedgerUnusable
from mesh.chain._pending import TransactionStore
from mesh.content import Store
from mesh.errors import ConfigurationError
from mesh.ops.state import back_up, restore
from schemas import cid_of_bytes
from tests.mesh.ops.state.conftest import ADDRESS, CHAIN, JOB, NONCE, OBJECTIVE, Folder, forge, members, names_in
from tests.support.agent.ledgers import mark_as_version
from tests.support.disks import file_size_limit
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import Iterator

AGENT = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1])
connection.execute("SELECT * FROM jobs")
print("open", flush=True)
time.sleep(60)
"""
RESTORING = """
import asyncio, pathlib, sys
from mesh.ops.state import restore
print("begins", flush=True)
asyncio.run(restore(*map(pathlib.Path, sys.argv[1:])))
"""


@contextmanager
def program(text: str, *arguments: Path) -> Iterator[None]:
    """A Python program that has printed its first line; it is killed at the end."""
    command = [sys.executable, "-c", text, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline()
            yield
        finally:
            process.kill()


@pytest.fixture
async def archive(folder: Folder, tmp_path: Path) -> Path:
    await back_up(folder.path, tmp_path / "it", content="all")
    return tmp_path / "it"


async def test_a_restored_state_is_the_one_that_was_backed_up(archive: Path, folder: Folder, tmp_path: Path) -> None:
    new = Folder(tmp_path / "new")

    done = await restore(archive, new.path)

    assert done.parts == (f"transactions/{CHAIN}/{ADDRESS.lower()}", ADDRESS)
    assert [(job.liability, job.phase, job.position) for job in done.jobs] == [(JOB, Phase.RUNNING, 3)]
    assert done.aside is None
    async with Ledger(new.ledger) as ledger:
        assert (await ledger.cursor())[0] == 99
        assert sum((await ledger.waiting_by_kind(head=0)).values()) == 1
    with closing(TransactionStore((new.path / NONCE).parent)) as store:
        assert store.read() == ({7: {"hash": "0x07"}}, frozenset())
    recording = f"{ADDRESS}/{CHAIN}/recordings/{JOB.address}.mcap.part"
    assert (new.path / recording).read_bytes() == (folder.path / recording).read_bytes()
    with Store(new.home / "content") as store:
        assert store.get_block(cid_of_bytes(OBJECTIVE)) is not None
        assert store.pins() == {cid_of_bytes(OBJECTIVE): {JOB.address}}
        assert len(store.list()) == 2
    assert names_in(new.path) == [ADDRESS, "transactions"]


async def test_an_existing_state_is_not_touched(archive: Path, folder: Folder) -> None:
    before = folder.contents()
    with raises_with(ConfigurationError, code="state-exists") as caught:
        await restore(archive, folder.path)
    assert ADDRESS in str(caught.value)
    assert folder.contents() == before


async def test_the_state_of_another_account_does_not_prevent_restoring(archive: Path, tmp_path: Path) -> None:
    other = tmp_path / "new" / ("0x" + "11" * 20) / "content"
    other.mkdir(parents=True)
    await restore(archive, tmp_path / "new")
    assert other.is_dir()
    assert (tmp_path / "new" / NONCE).exists()


async def test_the_old_state_can_be_set_aside_and_restored_by_hand(archive: Path, folder: Folder) -> None:
    async with Ledger(folder.ledger) as ledger:
        await ledger.set_phase(JOB.address, Phase.FINALIZED)
    secrets = [folder.path / "development" / "robot.json"]

    done = await restore(archive, folder.path, set_aside=True)

    assert done.aside is not None
    async with Ledger(folder.ledger) as ledger:
        assert await ledger.jobs_by_phase() == {"running": 1}
    async with Ledger(done.aside / ADDRESS / CHAIN / "ledger.sqlite") as ledger:
        assert await ledger.jobs_by_phase() == {"finalized": 1}
    assert (done.aside / NONCE).exists()
    assert all(secret.exists() for secret in secrets), "files that are not part of a state stay in place"


@pytest.mark.parametrize("set_aside", [False, True])
async def test_a_ledger_that_an_agent_has_open_is_in_use(archive: Path, folder: Folder, set_aside: bool) -> None:
    async with Ledger(folder.ledger):
        with raises_with(ConfigurationError, code="state-in-use"):
            await restore(archive, folder.path, set_aside=set_aside)
    await restore(archive, folder.path, set_aside=True)


async def test_a_ledger_that_another_process_has_open_is_in_use(archive: Path, folder: Folder) -> None:
    with program(AGENT, folder.ledger), raises_with(ConfigurationError, code="state-in-use"):
        await restore(archive, folder.path, set_aside=True)


async def test_a_store_that_is_open_is_in_use(archive: Path, folder: Folder) -> None:
    with Store(folder.home / "content"), raises_with(ConfigurationError, code="state-in-use"):
        await restore(archive, folder.path, set_aside=True)


async def test_a_table_of_transactions_that_a_program_has_open_is_in_use(archive: Path, folder: Folder) -> None:
    with (
        closing(TransactionStore((folder.path / NONCE).parent)),
        raises_with(ConfigurationError, code="state-in-use"),
    ):
        await restore(archive, folder.path, set_aside=True)


async def test_no_agent_can_open_a_state_while_it_is_replaced(
    archive: Path, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename
    refused: list[str] = []

    def open_ledger_and_rename(source: Path, target: Path) -> Path:
        if not refused:
            done = subprocess.run([sys.executable, "-c", AGENT, str(folder.ledger)], capture_output=True, text=True)
            refused.append(done.stderr)
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", open_ledger_and_rename)
    await restore(archive, folder.path, set_aside=True)
    assert "database is locked" in refused[0]


async def test_if_one_part_can_not_be_moved_nothing_changes(
    archive: Path, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, rename = folder.contents(), Path.rename
    targets: list[Path] = []

    def refuse_the_last(source: Path, target: Path) -> Path:
        targets.append(target)
        if len(targets) == 4:
            raise OSError(errno.EIO, "the disk is gone")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", refuse_the_last)
    with pytest.raises(ConfigurationError) as caught:
        await restore(archive, folder.path, set_aside=True)
    assert str(targets[3]) in str(caught.value)
    assert "the disk is gone" in str(caught.value)
    assert folder.contents() == before


async def test_a_newer_ledger_in_a_backup_is_named_and_nothing_changed(
    folder: Folder, archive: Path, tmp_path: Path
) -> None:
    newer = tmp_path / "newer.sqlite"
    newer.write_bytes(folder.ledger.read_bytes())
    mark_as_version(newer, VERSION + 1)
    forged = forge_ledger(archive, tmp_path / "forged", newer.read_bytes())
    with raises_with(ConfigurationError, code="state-too-new") as caught:
        await restore(forged, tmp_path / "new")
    assert f"format {VERSION + 1}, this one knows {VERSION}" in str(caught.value)
    assert names_in(tmp_path / "new") == []


async def test_a_newer_ledger_is_not_backed_up(folder: Folder, tmp_path: Path) -> None:
    mark_as_version(folder.ledger, VERSION + 1)
    with raises_with(ConfigurationError, code="state-too-new") as caught:
        await back_up(folder.path, tmp_path / "it", content="none")
    assert caught.value.hint == "upgrade aira-mesh"
    assert str(folder.ledger) in str(caught.value)


@pytest.mark.parametrize("data", [b"no ledger", b"SQLite format 3\x00" + bytes(4096)])
async def test_an_invalid_ledger_is_refused(archive: Path, tmp_path: Path, data: bytes) -> None:
    with pytest.raises(LedgerUnusable):
        await restore(forge_ledger(archive, tmp_path / "forged", data), tmp_path / "new")
    assert names_in(tmp_path / "new") == []


@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("CREATE VIEW more AS SELECT 1", "view"),
        ("CREATE TRIGGER more AFTER INSERT ON jobs BEGIN DELETE FROM outbox; END", "trigger"),
        ("CREATE VIRTUAL TABLE more USING fts5(words)", "virtual table"),
    ],
)
async def test_a_ledger_with_views_triggers_or_virtual_tables_is_refused(
    archive: Path, tmp_path: Path, statement: str, kind: str
) -> None:
    ledger = tmp_path / "active.sqlite"
    ledger.write_bytes(members(archive)[f"{ADDRESS}/{CHAIN}/ledger.sqlite"])
    with closing(sqlite3.connect(ledger)) as database:
        database.execute(statement)
        database.commit()
    with pytest.raises(LedgerUnusable, match=kind):
        await restore(forge_ledger(archive, tmp_path / "forged", ledger.read_bytes()), tmp_path / "new")
    assert names_in(tmp_path / "new") == []


def forge_ledger(archive: Path, forged: Path, data: bytes) -> Path:
    """The same backup with another ledger and its correct checksum."""
    sums = json.loads(members(archive)["checksums.json"])
    name = f"{ADDRESS}/{CHAIN}/ledger.sqlite"
    sums[name] = hashlib.sha256(data).hexdigest()

    def change(listed: list) -> None:  # type: ignore[type-arg]
        for place, (header, _) in enumerate(listed):
            new = {name: data, "checksums.json": json.dumps(sums).encode()}.get(header.name)
            if new is not None:
                header.size = len(new)
                listed[place] = (header, new)

    return forge(archive, forged, change)


async def test_a_full_disk_is_an_error_and_changes_nothing(archive: Path, tmp_path: Path) -> None:
    with file_size_limit(4096), pytest.raises(Exception, match=r"(?i)full"):
        await restore(archive, tmp_path / "new")
    assert names_in(tmp_path / "new") == []


async def test_an_unwritable_folder_is_an_error(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with raises_with(ConfigurationError, code="data-folder-unwritable") as caught:
        await restore(archive, tmp_path / "file")
    assert str(tmp_path / "file") in str(caught.value)


async def test_a_mounted_folder_is_kept_and_filled(archive: Path, tmp_path: Path) -> None:
    """Like the volume of a container, or a StateDirectory."""
    target = tmp_path / "volume"
    target.mkdir()
    inode = target.stat().st_ino
    await restore(archive, target)
    assert target.stat().st_ino == inode


async def test_a_killed_restore_leaves_only_complete_parts(archive: Path, tmp_path: Path) -> None:
    for number in range(8):
        target = Folder(tmp_path / f"new-{number}")
        with program(RESTORING, archive, target.path):
            await asyncio.sleep(number * 0.004)
        if target.home.exists():
            async with Ledger(target.ledger) as ledger:
                assert (await ledger.cursor())[0] == 99
            assert (target.path / NONCE).exists()

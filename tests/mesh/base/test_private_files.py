"""State on the disk is readable by its own user only, whatever the umask, and is tightened where it was more open."""

from __future__ import annotations

import os
import stat
from contextlib import closing
from typing import TYPE_CHECKING, Final

import pytest

from bridges.ipfs._relay import RelayJournal
from mesh.agent.ledger import Ledger
from mesh.base.clock import SYSTEM_CLOCK
from mesh.base.private_files import make_private_folder
from mesh.chain._pending import TransactionStore
from mesh.content import Store
from mesh.recording._recorder import PartialFile, RecordingAbout
from mesh.recording._recovery import recover
from schemas import cid_of_bytes

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    Make = Callable[[Path], Awaitable[None]]

CONTENT: Final = b"content"


@pytest.fixture(autouse=True)
def open_umask() -> Iterator[None]:
    """Nothing is masked: files get the mode that the code asks for."""
    umask = os.umask(0)
    yield
    os.umask(umask)


async def ledger(folder: Path) -> None:
    async with Ledger(folder / "chain" / "ledger.sqlite") as opened:
        await opened.set_cursor(1)
        check_private(folder)  # with the write-ahead log beside it


async def content(folder: Path) -> None:
    with Store(folder / "content") as store:
        cid = store.put_bytes(CONTENT)
        store.pin(cid)
        check_private(folder)


async def unfinished_recording(folder: Path) -> None:
    with PartialFile(folder / "recordings" / "job.mcap", RecordingAbout(), SYSTEM_CLOCK):
        pass


async def recovered_recording(folder: Path) -> None:
    await unfinished_recording(folder)
    recover(folder / "recordings" / "job.mcap.part")


async def transactions(folder: Path) -> None:
    with closing(TransactionStore(folder / "transactions")) as store:
        store.add(0, {"hash": "0x" + "11" * 32})
        check_private(folder)


async def journal(folder: Path) -> None:
    with RelayJournal(folder / "bridge" / "journal.sqlite"):
        check_private(folder)


PLACES: Final = (ledger, content, unfinished_recording, recovered_recording, transactions, journal)


def loosen(folder: Path) -> None:
    """Let others read all files and folders in it."""
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)


def check_private(folder: Path) -> None:
    """All files and folders in it are for their user only."""
    found = [path for path in folder.rglob("*") if not path.is_symlink()]
    assert found
    for path in found:
        mode = stat.S_IMODE(path.stat().st_mode)
        assert not mode & 0o077, f"{path} has {mode:o}"


@pytest.mark.parametrize("make", PLACES)
async def test_state_is_created_for_its_user_only(make: Make, tmp_path: Path) -> None:
    await make(tmp_path)
    check_private(tmp_path)


@pytest.mark.parametrize("make", [ledger, content, transactions, journal])
async def test_state_that_was_more_open_is_tightened_when_it_is_opened(make: Make, tmp_path: Path) -> None:
    await make(tmp_path)
    loosen(tmp_path)
    await make(tmp_path)
    check_private(tmp_path)


async def test_a_folder_that_users_share_stays_open(tmp_path: Path) -> None:
    shared = tmp_path / "tmp"
    shared.mkdir()
    shared.chmod(0o1777)
    make_private_folder(shared)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o1777


def test_missing_parents_are_private_and_existing_ones_stay_as_they_are(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o755)
    make_private_folder(home / "share" / "aira")
    assert [stat.S_IMODE(path.stat().st_mode) for path in (home, home / "share", home / "share" / "aira")] == [
        0o755,
        0o700,
        0o700,
    ]


def test_content_is_read_only(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        store.put_bytes(CONTENT)
    assert stat.S_IMODE((tmp_path / cid_of_bytes(CONTENT)).stat().st_mode) == 0o400

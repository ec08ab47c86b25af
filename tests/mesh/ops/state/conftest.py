"""Markets and data folders for the tests of this folder."""

from __future__ import annotations

import io
import tarfile
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

import pytest
import zstandard

from mesh.agent.ledger import Ledger, Outgoing, Phase
from mesh.chain._pending import TransactionStore
from mesh.content import Store
from schemas import cid_of_bytes
from tests.support.agent.samples import liability
from tests.support.orders import demand

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


ADDRESS = "0x3C44CdDdB6a900fa2b585dd299e03d12FA4293BC"
CHAIN = "1337-0badcafe"
OBJECTIVE = b"what to do"
UNUSED = b"what nobody needs"
PASSING = ("-wal", "-shm")
NONCE = f"transactions/{CHAIN}/{ADDRESS.lower()}/transactions.sqlite"


class Folder(NamedTuple):
    """A data folder of one agent, which does not run."""

    path: Path

    @property
    def home(self) -> Path:
        return self.path / ADDRESS

    @property
    def ledger(self) -> Path:
        return self.home / CHAIN / "ledger.sqlite"

    @property
    def recordings(self) -> Path:
        return self.home / CHAIN / "recordings"

    def contents(self) -> dict[str, bytes]:
        """All its files, except the temporary ones of SQLite."""
        found = sorted(path for path in self.path.rglob("*") if path.is_file() and path.suffix[-4:] not in PASSING)
        return {path.relative_to(self.path).as_posix(): path.read_bytes() for path in found}


JOB = liability("one", objective=cid_of_bytes(OBJECTIVE))


@pytest.fixture
async def folder(tmp_path: Path) -> Folder:
    """With a running job and its recording, an order that waits, a transaction, needed and other content, a secret."""
    made = Folder(tmp_path / "data")
    async with Ledger(made.ledger) as ledger:
        await ledger.add_job(JOB)
        await ledger.set_phase(JOB.address, Phase.RUNNING, position=3)
        await ledger.post(Outgoing.of(demand(objective=cid_of_bytes(OBJECTIVE))))
        await ledger.set_cursor(99)
    made.recordings.mkdir()
    (made.recordings / f"{JOB.address}.mcap.part").write_bytes(b"what it has said so far")
    with Store(made.home / "content") as store:
        store.put_bytes(OBJECTIVE, pin=JOB.address)
        store.put_bytes(UNUSED)
    with closing(TransactionStore((made.path / NONCE).parent)) as store:
        store.add(7, {"hash": "0x07"})
    (made.path / "development").mkdir()
    (made.path / "development" / "robot.json").write_text("a key")
    (made.home / "keyfile.json").write_text("another key")
    return made


def names_in(folder: Path) -> list[str]:
    """The names in a folder, with hidden files."""
    return sorted(path.name for path in folder.iterdir())


def unpacked(archive: Path) -> bytes:
    """The tar of a backup."""
    with archive.open("rb") as file, zstandard.ZstdDecompressor().stream_reader(file) as stream:
        return stream.read()


def members(archive: Path) -> dict[str, bytes]:
    """The files in a backup, read with other libraries."""
    with tarfile.open(fileobj=io.BytesIO(unpacked(archive))) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]


def forge(archive: Path, forged: Path, change: Callable[[list[tuple[tarfile.TarInfo, bytes]]], None]) -> Path:
    """A copy of the backup whose members `change` modified."""
    listed = []
    for name, data in members(archive).items():
        header = tarfile.TarInfo(name)
        header.size = len(data)
        listed.append((header, data))
    change(listed)
    plain = io.BytesIO()
    for header, data in listed:
        plain.write(header.tobuf(tarfile.USTAR_FORMAT))
        plain.write(data + bytes(-len(data) % 512))
    forged.write_bytes(zstandard.compress(plain.getvalue() + bytes(1024)))
    return forged

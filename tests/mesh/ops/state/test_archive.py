"""Backups that are forged, damaged or truncated."""

from __future__ import annotations

import io
import json
import os
import shutil
import tarfile
import tracemalloc
from typing import TYPE_CHECKING

import pytest
import zstandard

from mesh.errors import ConfigurationError, InputError
from mesh.ops.state import _archive as archives
from mesh.ops.state import back_up, examine_archive, restore
from tests.mesh.ops.state.conftest import ADDRESS, CHAIN, Folder, forge, members, names_in, unpacked
from tests.support.raising import raises_with

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Members = list[tuple[tarfile.TarInfo, bytes]]

CID = "Qm" + "1" * 44


@pytest.fixture
async def archive(folder: Folder, tmp_path: Path) -> Path:
    await back_up(folder.path, tmp_path / "it", content="all")
    return tmp_path / "it"


async def refused(archive: Path, tmp_path: Path) -> str:
    """What is said of it when it is refused; nothing of it is left anywhere."""
    (tmp_path / "new").mkdir(exist_ok=True)
    before = names_in(tmp_path)
    with raises_with(InputError, code="archive-unusable") as caught:
        await restore(archive, tmp_path / "new")
    assert names_in(tmp_path / "new") == []
    assert names_in(tmp_path) == before
    with raises_with(InputError, code="archive-unusable"):
        examine_archive(archive)
    assert "\n" not in str(caught.value)
    return str(caught.value)


NAMES = [
    "../outside",
    "/etc/passwd",
    f"{ADDRESS}/../../outside",
    f"{ADDRESS}/{CHAIN}/ledger.sqlite/../../../outside",
    f"{ADDRESS}/{CHAIN}/ledger.sqlite-wal",
    f"{ADDRESS}/{CHAIN}/recordings/it.mcap",
    f"{ADDRESS}/content/.blocks.sqlite",
    f"{ADDRESS}/keyfile.json",
    f"{ADDRESS}/{CHAIN}/ledger.sqlite\n",
    "transactions/1/x/transactions.sqlite",
    "development/robot.json",
    "",
]


@pytest.mark.parametrize("name", NAMES)
async def test_an_unexpected_file_name_is_refused(archive: Path, tmp_path: Path, name: str) -> None:
    def change(members: Members) -> None:
        header = tarfile.TarInfo(name)
        header.size = 4
        members.insert(2, (header, b"evil"))

    assert "not part of a state" in await refused(forge(archive, tmp_path / "forged", change), tmp_path)


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE])
async def test_only_plain_files_are_accepted(archive: Path, tmp_path: Path, kind: bytes) -> None:
    def change(members: Members) -> None:
        header = tarfile.TarInfo(f"{ADDRESS}/{CHAIN}/recordings/{ADDRESS}.mcap")
        header.type, header.linkname = kind, "/etc/passwd"
        members.insert(2, (header, b""))

    assert "not a regular file" in await refused(forge(archive, tmp_path / "forged", change), tmp_path)


@pytest.mark.parametrize("kind", [tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE])
async def test_a_huge_header_does_not_allocate_memory(archive: Path, tmp_path: Path, kind: bytes) -> None:
    def change(members: Members) -> None:
        header = tarfile.TarInfo("long")
        header.type, header.size = kind, 300 << 20
        members.insert(0, (header, bytes(300 << 20)))

    forged = forge(archive, tmp_path / "forged", change)
    tracemalloc.start()
    try:
        assert "not a regular file" in await refused(forged, tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


async def test_a_duplicate_file_is_refused(archive: Path, tmp_path: Path) -> None:
    forged = forge(archive, tmp_path / "forged", lambda members: members.insert(2, members[1]))
    assert "not part of a state" in await refused(forged, tmp_path)


async def test_a_file_larger_than_the_free_space_is_refused_at_its_header(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def change(members: Members) -> None:
        members[1][0].size = 8**11 - 1

    usage = shutil.disk_usage(tmp_path)._replace(free=4 << 30)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage)
    assert "more space" in await refused(forge(archive, tmp_path / "forged", change), tmp_path)


async def test_more_files_than_checksums_can_list_are_refused_early(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty file costs a forger a few bits, and the disk a name."""

    def change(members: Members) -> None:
        del members[-1]
        members += [(tarfile.TarInfo(f"{ADDRESS}/content/.pins/{CID}/{number}"), b"") for number in range(100)]

    forged = forge(archive, tmp_path / "forged", change)
    monkeypatch.setattr(archives, "LARGEST_TEXT", 10_000)
    assert "more files" in await refused(forged, tmp_path)


async def test_a_backup_with_too_many_files_to_restore_is_not_made(
    folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "LARGEST_TEXT", 500)
    with raises_with(ConfigurationError, code="too-many-files"):
        await back_up(folder.path, tmp_path / "it", content="all")
    assert names_in(tmp_path) == ["data"]


async def test_a_prepared_temporary_file_gets_no_data(folder: Folder, tmp_path: Path) -> None:
    """In a shared folder such as /tmp, under the temporary name of the backup."""
    prepared = tmp_path / f".it.{os.getpid()}"
    prepared.touch(mode=0o666)
    with prepared.open("rb") as kept_open:
        await back_up(folder.path, tmp_path / "it", content="none")
        assert kept_open.read() == b""
    assert (tmp_path / "it").stat().st_mode & 0o777 == 0o600


def changed(archive: Path, forged: Path, place: float) -> Path:
    data = bytearray(archive.read_bytes())
    data[int(len(data) * place)] ^= 0x10
    forged.write_bytes(data)
    return forged


async def test_a_flipped_bit_is_detected(archive: Path, tmp_path: Path) -> None:
    """Except bits without effect, such as the window size of a frame."""
    found = 0
    for place in range(40):
        forged = changed(archive, tmp_path / "forged", place / 40)
        if still_the_same(archive, forged):
            continue
        await refused(forged, tmp_path)
        found += 1
    assert found > 30


def still_the_same(archive: Path, forged: Path) -> bool:
    try:
        return unpacked(forged) == unpacked(archive)
    except zstandard.ZstdError:
        return False


async def test_a_changed_file_is_detected_by_its_checksum(archive: Path, tmp_path: Path) -> None:
    def change(members: Members) -> None:
        header, data = members[2]
        members[2] = (header, data.replace(b"so far", b"sO far"))

    assert "the checksum of" in await refused(forge(archive, tmp_path / "forged", change), tmp_path)


@pytest.mark.parametrize("place", [1, 2, -2])
async def test_a_missing_file_is_detected(archive: Path, tmp_path: Path, place: int) -> None:
    def change(members: Members) -> None:
        del members[place]

    assert "the checksum of" in await refused(forge(archive, tmp_path / "forged", change), tmp_path)


def cut(archive: Path, cut: Path, part: float) -> Path:
    data = archive.read_bytes()
    cut.write_bytes(data[: int(len(data) * part)])
    return cut


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.99])
async def test_a_truncated_backup_is_detected(archive: Path, tmp_path: Path, part: float) -> None:
    assert "truncated" in await refused(cut(archive, tmp_path / "cut", part), tmp_path)


async def test_a_backup_without_checksums_is_damaged(archive: Path, tmp_path: Path) -> None:
    forged = forge(archive, tmp_path / "forged", lambda members: members.__delitem__(slice(-1, None)))
    assert "not a backup" in await refused(forged, tmp_path)


def about(**changes: object) -> Callable[[Members], None]:
    def change(members: Members) -> None:
        said = json.dumps(json.loads(members[0][1]) | changes).encode()
        members[0][0].size = len(said)
        members[0] = (members[0][0], said)

    return change


async def test_a_newer_format_is_refused_with_both_versions(archive: Path, tmp_path: Path) -> None:
    forged = forge(archive, tmp_path / "forged", about(format=2, parts=5))
    assert "another version" in await refused(forged, tmp_path)


@pytest.mark.parametrize("changes", [{"parts": 5}, {"parts": [5]}, {"made": None}])
async def test_an_invalid_description_is_refused(archive: Path, tmp_path: Path, changes: dict[str, object]) -> None:
    assert "damaged" in await refused(forge(archive, tmp_path / "forged", about(**changes)), tmp_path)


async def test_parts_outside_the_folder_are_refused(archive: Path, tmp_path: Path, folder: Folder) -> None:
    """Parts that the backup names but does not contain are not moved."""
    outside = tmp_path / "outside"
    outside.mkdir()
    parts = [*json.loads(members(archive)["state.json"])["parts"], "../outside", str(outside), ""]
    forged = forge(archive, tmp_path / "forged", about(parts=parts))
    assert "parts that no state has" in await refused(forged, tmp_path)
    assert outside.is_dir()


async def test_data_after_the_end_is_refused(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "longer").write_bytes(zstandard.compress(unpacked(archive) + b"more"))
    assert "data after its end" in await refused(tmp_path / "longer", tmp_path)


@pytest.mark.parametrize("data", [b"", b"{}", zstandard.compress(b""), zstandard.compress(bytes(2048))])
async def test_other_files_are_no_backups(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "other").write_bytes(data)
    await refused(tmp_path / "other", tmp_path)


async def test_another_tar_is_no_backup(tmp_path: Path) -> None:
    plain = io.BytesIO()
    with tarfile.open(fileobj=plain, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        tar.addfile(tarfile.TarInfo("readme"))
    (tmp_path / "other").write_bytes(zstandard.compress(plain.getvalue()))
    assert "not a backup" in await refused(tmp_path / "other", tmp_path)

"""The disk: a folder that can't be written, a disk that is full, and one that soon will be."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from mesh.ops.doctor import CheckStatus, DoctorContext
from mesh.ops.doctor._machine import DISK_LIMITS, check_data_folder, check_disk_space
from mesh.settings import Settings
from tests.support.commands import run
from tests.support.disks import file_size_limit
from tests.support.doctor.examining import examined
from tests.support.routers import EmbeddedRouter

if TYPE_CHECKING:
    from pathlib import Path

AS_NOBODY = """
import os, sys
from pathlib import Path
from mesh.ops.doctor._machine import check_data_folder, check_disk_space
folder = Path(sys.argv[1])
if os.geteuid() == 0:
    os.setgroups([]), os.setgid(65534), os.setuid(65534)
print(*{look}, sep="\\n")
"""


def test_a_writable_folder_passes_and_is_left_empty(tmp_path: Path) -> None:
    result = check_data_folder(tmp_path, slow=60)

    assert result.status is CheckStatus.OK
    assert result.code == "ok"
    assert str(tmp_path) in result.message
    assert list(tmp_path.iterdir()) == []


def test_for_a_missing_folder_its_nearest_parent_is_checked(tmp_path: Path) -> None:
    result = check_data_folder(tmp_path / "a" / "b", slow=60)

    assert result.code == "folder-missing"
    assert str(tmp_path / "a" / "b") in result.message
    assert not (tmp_path / "a").exists()


def test_a_folder_of_another_user_is_reported_with_both_users_and_a_hint(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    for parent in tmp_path.parents:
        if parent.stat().st_uid == os.geteuid() and parent != parent.parent:
            parent.chmod(parent.stat().st_mode | 0o011)
    done = run(sys.executable, "-c", AS_NOBODY.format(look="check_data_folder(folder)"), tmp_path)

    status, code, found, do = done.stdout.splitlines()
    assert (status, code) == ("CheckStatus.FAIL", "not-writable"), done.stderr
    assert str(tmp_path) in found
    assert do.startswith("sudo chown -R ")
    assert "--data-dir" in do


def test_the_hint_never_changes_the_owner_of_a_parent_folder(tmp_path: Path) -> None:
    folder = tmp_path / "aira" / "state"
    for parent in tmp_path.parents:
        if parent.stat().st_uid == os.geteuid() and parent != parent.parent:
            parent.chmod(parent.stat().st_mode | 0o011)
    for mode in (0o555, 0o500):
        tmp_path.chmod(mode)
        done = run(sys.executable, "-c", AS_NOBODY.format(look="check_data_folder(folder)"), folder)
        _, _, found, do = done.stdout.splitlines()
        assert f"{tmp_path} is not writable: Permission denied" in found
        assert do.startswith("sudo install -d -o ")
        assert do.endswith(f" {folder}, or use another folder with --data-dir")


def test_files_that_this_user_can_not_read_are_not_counted(tmp_path: Path) -> None:
    store = tmp_path / "0xAb" / "content"
    store.mkdir(parents=True)
    (store / "Qm").write_bytes(bytes(16))
    (store / "dangling").symlink_to(tmp_path / "nowhere")
    store.chmod(0o744)
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and folder != folder.parent:
            folder.chmod(folder.stat().st_mode | 0o055)
    done = run(sys.executable, "-c", AS_NOBODY.format(look="check_disk_space(folder, content_limit=1)"), tmp_path)

    assert done.stdout.splitlines()[:1] == ["CheckStatus.OK"], done.stderr


async def test_a_data_dir_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("")
    with EmbeddedRouter() as router:
        settings = Settings(connect=(router.endpoint,), data_dir=str(tmp_path / "state" / "deeper"))
        found = await examined(DoctorContext(settings=settings, requested_role="bridge"))

    assert "data folder" in found.failed
    assert found.one("data folder").code == "not-writable"
    assert found.one("data folder").hint == "use another folder with --data-dir"
    assert "disk space" not in found


def test_a_full_disk_is_reported_as_full(tmp_path: Path) -> None:
    with file_size_limit(1024):
        result = check_data_folder(tmp_path, slow=60)

    assert not result.ok
    assert result.code == "disk-full"
    assert list(tmp_path.iterdir()) == []


def test_enough_space_for_the_content_limit_passes(tmp_path: Path) -> None:
    assert check_disk_space(tmp_path, content_limit=1024).status is CheckStatus.OK


def test_a_content_limit_beyond_the_disk_is_a_warning(tmp_path: Path) -> None:
    store = tmp_path / "0xAb" / "content"
    store.mkdir(parents=True)
    (store / "Qm").write_bytes(b"")
    os.truncate(store / "Qm", 3 * 1024**3)

    result = check_disk_space(tmp_path, content_limit=1024**5)

    assert result.status is CheckStatus.WARN
    assert result.code == "disk-space"
    assert "3.0 GiB" in result.message
    assert "--content-limit" in result.hint


def test_a_disk_without_room_for_a_ledger_fails(tmp_path: Path) -> None:
    assert not check_disk_space(tmp_path, content_limit=1024, least=1024**6).ok
    assert check_disk_space(tmp_path, content_limit=1024, least=DISK_LIMITS.free).ok


def test_a_slow_disk_is_a_warning(tmp_path: Path) -> None:
    result = check_data_folder(tmp_path, slow=0)

    assert result.status is CheckStatus.WARN
    assert "--data-dir" in result.hint

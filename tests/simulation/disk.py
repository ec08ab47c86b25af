"""What a crash of the machine leaves of a folder: what was synced, and chance decides about the rest.

Files are real. What `os.fsync` was called for is remembered here; SQLite syncs by itself at each commit.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tests.simulation.threads import scheduler

if TYPE_CHECKING:
    from collections.abc import Iterator

DATABASES: Final = (".sqlite", ".sqlite-wal", ".sqlite-shm", "-wal", "-shm", "-journal")
_FSYNC = os.fsync


class SimulatedDisk:
    """The disk under the folder at `root`: of all processes, each with its own folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._synced: dict[int, bytes] = {}
        """What files have on the disk, by inode."""
        self._entries: dict[int, dict[str, int]] = {}
        """What directories have on the disk: names and inodes."""
        self.seen: Counter[str] = Counter()

    def fsync(self, descriptor: int) -> None:
        """`os.fsync`."""
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            path = f"/proc/self/fd/{descriptor}"
            self._entries[found.st_ino] = {entry.name: entry.inode() for entry in os.scandir(path)}
        else:
            self._synced[found.st_ino] = (
                os.pread(descriptor, found.st_size, 0) if _readable(descriptor) else _content(descriptor)
            )
        process = scheduler().process
        if process is not None:
            process.commit()

    def crash(self, folder: Path, *, power: bool) -> None:
        """Bring a folder to what a crash leaves: all that was written, unless the machine lost its `power`.

        The files are copies: the locks of the dead process are on the old ones.
        """
        gone = folder.with_name(f"{folder.name}.gone")
        folder.rename(gone)
        self._restore(gone, folder, power=power)
        shutil.rmtree(gone)

    def _restore(self, gone: Path, folder: Path, *, power: bool) -> None:
        folder.mkdir()
        chance, entries = scheduler().random, self._entries.get(gone.stat().st_ino)
        for path in sorted(gone.iterdir()):
            target = folder / path.name
            if path.is_dir():
                self._restore(path, target, power=power)
                continue
            inode, kept = path.stat().st_ino, path.read_bytes()
            synced = self._synced.get(inode)
            if power and not path.name.endswith(DATABASES):
                if synced is None and path.name not in (entries or ()) and chance.random() < 0.5:
                    self.seen["file-lost"] += 1
                    continue
                now, kept = kept, _torn(kept, synced or b"")
                self.seen["write-torn"] += kept != now
                synced = kept
            target.write_bytes(kept)
            shutil.copystat(path, target)
            if synced is not None:
                self._synced[target.stat().st_ino] = synced
        if entries is not None:
            self._entries[folder.stat().st_ino] = entries

    def install(self) -> None:
        """Take the place of `os.fsync`."""
        os.fsync = self.fsync  # type: ignore[assignment]


def _torn(now: bytes, synced: bytes) -> bytes:
    """What is left of a file: all, what was synced, or a part of what was added since."""
    if now == synced:
        return now
    chance = scheduler().random
    choice = chance.random()
    if choice < 0.3:
        return now
    if choice < 0.6 or not now.startswith(synced):
        return synced
    return now[: chance.randint(len(synced), len(now))]


def _readable(descriptor: int) -> bool:
    import fcntl

    return fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE != os.O_WRONLY


def _content(descriptor: int) -> bytes:
    return Path(f"/proc/self/fd/{descriptor}").read_bytes()


def files(folder: Path) -> Iterator[Path]:
    """All files under a folder."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file())

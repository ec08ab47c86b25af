"""Where state is kept: whether it can be written there, for certain, and whether there is room. Everything blocks."""

from __future__ import annotations

import errno
import os
import pwd
import shutil
import stat
import tempfile
import time
from typing import TYPE_CHECKING, Final

from mesh.doctor.findings import Finding, broken, doubtful, sound

if TYPE_CHECKING:
    from pathlib import Path

PROBE: Final = 64 * 1024
"""Bytes that are written for a test, and deleted."""
LEAST: Final = 100 * 1024**2
"""Bytes without which ledger and recordings soon come to an end."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN: Final = (errno.EACCES, errno.EPERM)
SLOW: Final = 1.0
"""Seconds for a small file, beyond which a disk is not fit for a ledger that is synced at each step."""


def look_at_folder(folder: Path) -> Finding:
    """Whether the state's folder, or where it is to be made, takes a file for good."""
    there = _nearest(folder)
    began = time.monotonic()
    try:
        with tempfile.NamedTemporaryFile(dir=there, prefix=".aira-doctor-") as probe:
            probe.write(bytes(PROBE))
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        return _refused(folder, there, error)
    took = time.monotonic() - began
    if took > SLOW:
        return doubtful(
            f"{there} takes {took:.1f} s to keep a small file for certain",
            do="use a local disk for --data-dir; each step of a job waits for it",
        )
    if there != folder:
        return sound(f"{folder} is made at the start; {there} takes it")
    return sound(f"{folder} is written and synced in {took * 1000:.0f} ms, and belongs to {_owner(folder)}")


def look_at_room(folder: Path, *, content_limit: int, least: int = LEAST) -> Finding:
    """Whether the files, which may grow to `content_limit` bytes, have room, and there are `least` bytes free now."""
    free = shutil.disk_usage(_nearest(folder)).free
    kept = sum(map(_size, folder.glob("*/content/*")))
    shown = f"{_gigabytes(free)} free, {_gigabytes(kept)} kept of at most {_gigabytes(content_limit)}"
    if free < least:
        return broken(f"{shown} in {folder}", do="free some space, or give --data-dir on another disk")
    if free + kept < content_limit:
        return doubtful(shown, do="give a --content-limit that the disk has room for, or free some space")
    return sound(shown)


def _refused(folder: Path, there: Path, error: OSError) -> Finding:
    """Why `there`, which is the folder or where it is to be made, takes no file."""
    if error.errno in FULL:
        return broken(
            f"the disk of {there} is full: {error.strerror}",
            do="free some space there, or give --data-dir on another disk",
        )
    other = "give another folder with --data-dir"
    if error.errno not in FORBIDDEN:
        return broken(f"{there} can't be written: {error.strerror}", do=other)
    user = os.geteuid()
    # What is above the folder may be the system's, and is to stay so.
    own = f"sudo chown -R {user} {folder}" if there == folder else f"sudo install -d -o {user} {folder}"
    return broken(
        f"{there} can't be written: {error.strerror}; it belongs to {_owner(there)}, and this is {_user(user)}",
        do=f"{own}, or {other}",
    )


def _nearest(folder: Path) -> Path:
    """The folder, or the first one above it that there is, as far as this user sees."""
    return next(path for path in (folder, *folder.absolute().parents) if os.path.exists(path))


def _size(path: Path) -> int:
    """Bytes of a file; none of one that is deleted meanwhile, or that this user does not see."""
    try:
        about = path.stat()
    except OSError:
        return 0
    return about.st_size if stat.S_ISREG(about.st_mode) else 0


def _owner(path: Path) -> str:
    try:
        return _user(path.stat().st_uid)
    except OSError:
        return "nobody known"


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"the user {number}"


def _gigabytes(size: int) -> str:
    return f"{size / 1024**3:,.1f} GiB"

"""This machine: its clock compared with others, and the disk with its state.

A wrong clock makes certificates look expired or not yet valid, and the times in recordings useless. The checks of the
disk block.
"""

from __future__ import annotations

import errno
import os
import pwd
import shutil
import stat
import tempfile
import time
from typing import TYPE_CHECKING, Final

from mesh.doctor.checks import CheckResult, failed, passed, warning
from mesh.network.endpoints import SPARE_DESCRIPTORS, room_for_sessions

if TYPE_CHECKING:
    from pathlib import Path

DAY: Final = 86_400.0
SOON: Final = 7 * DAY
"""A certificate should be renewed this many seconds before it expires."""
TOLERATED: Final = 5.0
"""Seconds by which two clocks may differ."""
AHEAD: Final = 30.0
"""Seconds by which a block may be in the future: development chains add a second per block, even if they are faster."""
RECENT: Final = 120.0
"""Seconds for which the time of a block can be compared with the clock."""
CURE: Final = (
    "set the clock, preferably by NTP (timedatectl set-ntp true); the validity of certificates and the times in"
    " recordings depend on it"
)
PROBE: Final = 64 * 1024
"""Bytes written as a test and deleted."""
LEAST: Final = 100 * 1024**2
"""Free bytes below which writing the ledger and recordings will soon fail."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN: Final = (errno.EACCES, errno.EPERM)
SLOW: Final = 1.0
"""Seconds for a small file above which a disk is too slow for a ledger that is synced at each step."""


def compare_router_clock(theirs: float, ours: float) -> CheckResult:
    """Compare the router's clock with this one, both read at the same moment (seconds since the epoch)."""
    ahead = ours - theirs
    if abs(ahead) <= TOLERATED:
        return passed(f"differs by {abs(ahead):.2f} s from the router's clock")
    return failed(f"this machine's clock is {_apart(ahead)} the router's", code="clock-off", hint=CURE)


def compare_node_clock(theirs: float, ours: float) -> CheckResult:
    """Compare the clock of the node's machine, in whole seconds, with this one (seconds since the epoch)."""
    ahead = ours - theirs
    if abs(ahead) <= TOLERATED + 1:
        return passed("agrees with the node's clock to the second")
    return failed(
        f"this machine's clock is {_apart(ahead)} the clock of the node's machine", code="clock-off", hint=CURE
    )


def compare_chain_clock(block_time: float, ours: float) -> CheckResult:
    """Compare the time of the newest block with this clock (seconds since the epoch)."""
    age = ours - block_time
    if age < -AHEAD:
        return failed(
            f"this machine's clock is {duration(-age)} behind the newest block", code="clock-behind", hint=CURE
        )
    if age > RECENT:
        return passed(f"the newest block is {duration(age)} old, too old to compare clocks", code="block-too-old")
    return passed(f"agrees with the newest block, {'0 s' if age < 1 else duration(age)} old")


def duration(seconds: float) -> str:
    """A duration in the most readable unit."""
    for name, length in (("days", DAY), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {name}"
    return f"{seconds:.0f} s"


def time_left(until: float) -> str:
    """How long it is until then (seconds since the epoch)."""
    left = until - time.time()
    return f"{duration(left)} left" if left > 0 else "expired"


def _apart(ahead: float) -> str:
    return f"{duration(abs(ahead))} {'ahead of' if ahead > 0 else 'behind'}"


def check_data_folder(folder: Path, *, slow: float = SLOW) -> CheckResult:
    """Whether a file can be written and synced in the state's folder, or where that will be created.

    Taking more than `slow` seconds is a warning.
    """
    existing = _nearest(folder)
    began = time.monotonic()
    try:
        with tempfile.TemporaryFile(dir=existing) as probe:
            probe.write(bytes(PROBE))
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        return _write_failure(folder, existing, error)
    took = time.monotonic() - began
    if took > slow:
        return warning(
            f"{existing} takes {took:.1f} s to write and sync a small file",
            code="disk-slow",
            hint="use a local disk for --data-dir; each step of a job waits for the disk",
        )
    if existing != folder:
        return passed(f"{folder} will be created on start; {existing} is writable", code="folder-missing")
    return passed(f"{folder} is writable (a file was synced in {took * 1000:.0f} ms) and belongs to {_owner(folder)}")


def check_disk_space(folder: Path, *, content_limit: int, least: int = LEAST) -> CheckResult:
    """Whether at least `least` bytes are free, and the store has room to grow to `content_limit` bytes."""
    free = shutil.disk_usage(_nearest(folder)).free
    kept = sum(map(_size, folder.glob("*/content/*")))
    shown = f"{_gigabytes(free)} free, content uses {_gigabytes(kept)} of at most {_gigabytes(content_limit)}"
    if free < least:
        return failed(
            f"{shown} in {folder}", code="disk-space", hint="free some space, or use another disk with --data-dir"
        )
    if free + kept < content_limit:
        return warning(shown, code="disk-space", hint="reduce --content-limit, or free some space")
    return passed(shown)


def check_descriptors(max_sessions: int) -> CheckResult:
    """Whether a router started like this process may open a file descriptor for each of `max_sessions`."""
    room = room_for_sessions()
    if room >= max_sessions:
        return passed(f"there are file descriptors for {max_sessions:,} sessions")
    return warning(
        f"there are file descriptors for {room:,} sessions, not for {max_sessions:,}",
        code="few-descriptors",
        hint=f"raise the hard limit of open files to {max_sessions + SPARE_DESCRIPTORS} (LimitNOFILE in a systemd unit,"
        f" or ulimit -Hn), or give the router --max-sessions {room}",
    )


def _write_failure(folder: Path, existing: Path, error: OSError) -> CheckResult:
    """Why no file can be written in `existing`: the folder, or the one in which it will be created."""
    if error.errno in FULL:
        return failed(
            f"the disk of {existing} is full: {error.strerror}",
            code="disk-full",
            hint="free some space there, or use another disk with --data-dir",
        )
    other = "use another folder with --data-dir"
    if error.errno not in FORBIDDEN:
        return failed(f"{existing} is not writable: {error.strerror}", code="not-writable", hint=other)
    user = os.geteuid()
    # A folder above may belong to the system: don't suggest changing its owner.
    own = f"sudo chown -R {user} {folder}" if existing == folder else f"sudo install -d -o {user} {folder}"
    return failed(
        f"{existing} is not writable: {error.strerror}; it belongs to {_owner(existing)}, not to {_user(user)}",
        code="not-writable",
        hint=f"{own}, or {other}",
    )


def _nearest(folder: Path) -> Path:
    """The folder, or the nearest existing one above it that this user can see."""
    return next(path for path in (folder, *folder.absolute().parents) if os.path.exists(path))


def _size(path: Path) -> int:
    """Bytes of a file; 0 if it was deleted meanwhile or this user can't see it."""
    try:
        about = path.stat()
    except OSError:
        return 0
    return about.st_size if stat.S_ISREG(about.st_mode) else 0


def _owner(path: Path) -> str:
    try:
        return _user(path.stat().st_uid)
    except OSError:
        return "an unknown user"


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"the user {number}"


def _gigabytes(size: int) -> str:
    return f"{size / 1024**3:,.1f} GiB"

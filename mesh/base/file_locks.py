"""Locks of files: a process holds one until it closes the file, or ends, by whatever.

They are those of `flock`, which Windows does not have: `fcntl` is imported where a file is locked.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

if TYPE_CHECKING:
    from pathlib import Path

Locked: TypeAlias = int | BinaryIO
"""An open file, or its descriptor."""


def lock(file: Locked) -> None:
    """Lock a file for this opening of it alone; waits while another one has it."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX)


def lock_shared(file: Locked) -> None:
    """Lock a file together with others that share it; waits while one has it alone. Gives up a lock for it alone."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_SH)


def try_lock(file: Locked) -> bool:
    """Lock a file for this opening of it alone, unless another one has it; whether that succeeded."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_locked(path: Path, *, ours_is_shared: bool = False) -> bool:
    """Whether this process or another has the file at `path` locked, so that it could not be locked as well."""
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if ours_is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False

"""Opening a store's directory: what a crash left is cleared, and the index made to agree with the files."""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.content.chunking import enter_blocks
from mesh.content.errors import StoreDamaged
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, directory_lock, is_taken, stamp, sync_directory
from mesh.content.index import BlockIndex
from mesh.errors import InvalidCid
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

DAMAGED_SUFFIX: Final = ".corrupt"
"""Ends the name of a file that was set aside because it is not the one of its name."""

_INDEX: Final = ".blocks.sqlite"
_IN_USE: Final = ".open"
_PART_SECONDS: Final = 7 * 24 * 3600
"""Age at which the remains of a fetch that nobody took up again are deleted."""


def open_directory(directory: Path) -> tuple[BlockIndex, int]:
    """Clear what crashes left in the directory, and hash files that the index does not know.

    Returns the index and a descriptor to be closed after it, by which other processes tell that it is in use. One
    process opens a directory at a time. Raises `StoreDamaged`, and `OSError` when the directory can't be used.
    """
    with directory_lock(directory):
        in_use = os.open(directory / _IN_USE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(in_use, fcntl.LOCK_SH)
            index = _open_index(directory / _INDEX, in_use)
        except BaseException:
            os.close(in_use)
            raise
        try:
            clear_remains(directory, index)
            _reconcile(directory, index)
        except BaseException:
            index.close()
            os.close(in_use)
            raise
    return index, in_use


def is_in_use(directory: Path) -> bool:
    """Whether a store has the directory open, in this process or another."""
    return is_taken(directory / _IN_USE)


def held_in(directory: Path) -> tuple[str, ...]:
    """The CIDs that files of the directory are named by, sorted."""
    return tuple(sorted(name for name in os.listdir(directory) if is_cid(name)))


def damaged_in(directory: Path) -> tuple[str, ...]:
    """The CIDs of files that were set aside, and not had again since; sorted."""
    names = (name.removesuffix(DAMAGED_SUFFIX) for name in os.listdir(directory) if name.endswith(DAMAGED_SUFFIX))
    return tuple(sorted(name for name in names if is_cid(name)))


def set_aside(path: Path, index: BlockIndex, *, seen: tuple[int, ...]) -> bool:
    """Rename a file that is not what its name says to `CID.corrupt`, and forget its blocks.

    Whether that was done: not when its stamp is not `seen` any more, for then another file is there. The directory's
    lock must be held.
    """
    damaged = path.with_name(f"{path.name}{DAMAGED_SUFFIX}")
    with suppress(FileNotFoundError):
        if stamp(path) != seen:
            return False
        path.rename(damaged)
        sync_directory(path.parent)
    index.empty(path.name, damaged.name)
    return True


def clear_remains(directory: Path, index: BlockIndex) -> None:
    """Delete what writers that live no more have left. The directory's lock must be held."""
    for path in directory.glob(f"{PUT_PREFIX}*"):
        _delete_unless_written(path, index)
    for path in directory.glob(f"{PART_PREFIX}*"):
        with suppress(FileNotFoundError):
            held = (directory / path.name.removeprefix(PART_PREFIX)).exists()
            if held or time.time() - path.stat().st_mtime > _PART_SECONDS:
                _delete_unless_written(path, index)


def is_cid(name: str) -> bool:
    """Whether a file's name is a CIDv0."""
    try:
        parse_cid(name)
    except InvalidCid:
        return False
    return True


def _open_index(path: Path, in_use: int) -> BlockIndex:
    try:
        return BlockIndex(path)
    except sqlite3.OperationalError as error:  # locked, read-only, no disk: nothing that a new index would mend
        raise StoreDamaged(path.parent, f"its index {path.name} can't be opened: {error}") from error
    except sqlite3.DatabaseError as error:
        log.warning("the block index %s is unusable (%s) and is built again", path, error)
    try:
        fcntl.flock(in_use, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise StoreDamaged(path.parent, f"its index {path.name} is unusable, and others have it open") from None
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    fcntl.flock(in_use, fcntl.LOCK_SH)
    return BlockIndex(path)


def _delete_unless_written(path: Path, index: BlockIndex) -> None:
    remains = TemporaryFile.take(path)
    if remains is not None:
        with remains:
            index.forget(path.name)


def _reconcile(directory: Path, index: BlockIndex) -> None:
    """Make the index know the files that are there, and no others."""
    names = frozenset(os.listdir(directory))
    known = frozenset(file.name for file in index.files())
    for name in known - names:
        index.forget(name)
    for name in names - known:
        if is_cid(name):
            _enter_file(directory / name, index)
        elif name.startswith(PART_PREFIX) or name.endswith(DAMAGED_SUFFIX):
            index.add(name, (), size=(directory / name).stat().st_size)


def _enter_file(path: Path, index: BlockIndex) -> None:
    log.info("hashing %s, which the block index does not know", path)
    name, seen = f"{PUT_PREFIX}{path.name}", stamp(path)
    with path.open("rb") as stream:
        cid, size = enter_blocks(stream, index, name)
    index.add(name, (), size=size)
    if cid == path.name:
        index.rename(name, cid)
    else:
        log.warning("%s is not the file of its name, or was chunked with other settings: set aside", path)
        index.forget(name)
        index.add(path.name, (), size=size)
        set_aside(path, index, seen=seen)

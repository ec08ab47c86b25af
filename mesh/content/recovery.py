"""Opening the directory of a store: delete what a crash left behind, and make the index agree with the files."""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.content.errors import StoreDamaged
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, directory_lock, is_locked, stamp, sync_directory
from mesh.content.index import BlockIndex
from mesh.errors import InvalidCid
from mesh.log_context import log_event
from mesh.private_files import open_private
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

DAMAGED_SUFFIX: Final = ".corrupt"
"""Suffix of a file that was set aside because its bytes do not match its CID."""

_INDEX: Final = ".blocks.sqlite"
_IN_USE: Final = ".open"
_PART_SECONDS: Final = 7 * 24 * 3600
"""Age at which an unfinished fetch that was never continued is deleted."""


def open_directory(directory: Path) -> tuple[BlockIndex, int]:
    """Delete what crashes left in the directory, and hash files that the index does not know.

    Returns the index, and a descriptor to close after it: its lock shows other processes that the directory is in use.
    Processes open a directory one at a time. Raises `StoreDamaged`, and `OSError` if the directory can't be used.
    """
    with directory_lock(directory):
        in_use = open_private(directory / _IN_USE, os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(in_use, fcntl.LOCK_SH)
            index = _open_index(directory / _INDEX, in_use)
        except BaseException:
            os.close(in_use)
            raise
        try:
            delete_leftovers(directory, index)
            _reconcile(directory, index)
        except BaseException:
            index.close()
            os.close(in_use)
            raise
    return index, in_use


def is_in_use(directory: Path) -> bool:
    """Whether a store has the directory open, in this process or another."""
    return is_locked(directory / _IN_USE)


def set_aside(path: Path, index: BlockIndex, *, seen: tuple[int, ...]) -> bool:
    """Rename a file that does not match its CID to `CID.corrupt`, and drop its blocks from the index.

    Returns False, and does nothing, if the file's stamp is no longer `seen`: then it was replaced. The caller must
    hold the directory's lock.
    """
    damaged = path.with_name(f"{path.name}{DAMAGED_SUFFIX}")
    with suppress(FileNotFoundError):
        if stamp(path) != seen:
            return False
        path.rename(damaged)
        sync_directory(path.parent)
    index.drop_blocks(path.name, damaged.name)
    return True


def delete_leftovers(directory: Path, index: BlockIndex) -> None:
    """Delete the files of writers that are gone. The caller must hold the directory's lock."""
    for path in directory.glob(f"{PUT_PREFIX}*"):
        _delete_unless_locked(path, index)
    for path in directory.glob(f"{PART_PREFIX}*"):
        with suppress(FileNotFoundError):
            held = (directory / path.name.removeprefix(PART_PREFIX)).exists()
            if held or time.time() - path.stat().st_mtime > _PART_SECONDS:
                _delete_unless_locked(path, index)


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
    except sqlite3.OperationalError as error:  # locked, read-only, or no disk: a new index would not help
        raise StoreDamaged(path.parent, f"its index {path.name} can't be opened: {error}") from error
    except sqlite3.DatabaseError as error:
        event = log_event("content-index-rebuilt", path=path, error=error)
        log.warning("the block index %s is unusable (%s) and will be rebuilt", path, error, extra=event)
    try:
        fcntl.flock(in_use, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise StoreDamaged(path.parent, f"its index {path.name} is unusable, and other processes use it") from None
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    fcntl.flock(in_use, fcntl.LOCK_SH)
    return BlockIndex(path)


def _delete_unless_locked(path: Path, index: BlockIndex) -> None:
    leftover = TemporaryFile.take(path)
    if leftover is not None:
        with leftover:
            index.forget(path.name)


def _reconcile(directory: Path, index: BlockIndex) -> None:
    """Add files that the index does not know, and drop those that no longer exist."""
    names = frozenset(os.listdir(directory))
    known = frozenset(file.name for file in index.files())
    for name in known - names:
        index.forget(name)
    for name in names - known:
        if is_cid(name):
            _index_file(directory / name, index)
        elif name.startswith(PART_PREFIX) or name.endswith(DAMAGED_SUFFIX):
            index.add(name, (), size=(directory / name).stat().st_size)


def _index_file(path: Path, index: BlockIndex) -> None:
    event = log_event("content-reindexed", cid=path.name)
    log.info("hashing %s, which the block index does not have", path, extra=event)
    name, seen = f"{PUT_PREFIX}{path.name}", stamp(path)
    with path.open("rb") as stream:
        cid, size = index.add_stream(name, stream)
    index.add(name, (), size=size)
    if cid == path.name:
        index.rename(name, cid)
        return
    event = log_event("content-set-aside", cid=path.name, found=cid)
    log.warning("%s does not match its name, or was chunked with other settings: set aside", path, extra=event)
    index.forget(name)
    index.add(path.name, (), size=size)
    set_aside(path, index, seen=seen)

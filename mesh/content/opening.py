"""Making a directory ready to be a store: its index, the remains of crashes, files that the index does not know."""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from mesh.content.chunking import enter_blocks
from mesh.content.files import PART_PREFIX, PUT_PREFIX, TemporaryFile, directory_lock, sync_directory
from mesh.content.index import BlockIndex
from mesh.errors import InvalidCid
from schemas.cid import parse_cid

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

_INDEX: Final = ".blocks.sqlite"
_PART_SECONDS: Final = 7 * 24 * 3600
"""Age at which the remains of a fetch that nobody took up again are deleted."""


def open_directory(directory: Path) -> BlockIndex:
    """Make the directory if it is not there, clear what crashes left, hash files that the index does not know.

    One process does so at a time. Raises `OSError` when the directory can't be used.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with directory_lock(directory):
        index = _open_index(directory / _INDEX)
        _clear_remains(directory, index)
        known = index.names()
        for cid in held_in(directory):
            if cid not in known:
                _enter_file(directory / cid, index)
    return index


def held_in(directory: Path) -> tuple[str, ...]:
    """The CIDs that files of the directory are named by, sorted."""
    return tuple(sorted(name for name in os.listdir(directory) if _is_cid(name)))


def move_aside(path: Path, index: BlockIndex) -> None:
    """Rename a file that is not what its name says to `CID.corrupt`, and forget its blocks."""
    with suppress(FileNotFoundError):
        path.rename(path.with_name(f"{path.name}.corrupt"))
        sync_directory(path.parent)
    index.forget(path.name)


def _open_index(path: Path) -> BlockIndex:
    try:
        return BlockIndex(path)
    except sqlite3.DatabaseError as error:
        log.warning("the block index %s is unusable (%s) and is built again", path, error)
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        return BlockIndex(path)


def _clear_remains(directory: Path, index: BlockIndex) -> None:
    """Delete what writers that live no more have left."""
    for path in directory.glob(f"{PUT_PREFIX}*"):
        _delete_unless_written(path, index)
    for path in directory.glob(f"{PART_PREFIX}*"):
        if time.time() - path.stat().st_mtime > _PART_SECONDS:
            _delete_unless_written(path, index)


def _delete_unless_written(path: Path, index: BlockIndex) -> None:
    remains = TemporaryFile.take(path)
    if remains is not None:
        with remains:
            index.forget(path.name)


def _enter_file(path: Path, index: BlockIndex) -> None:
    log.info("hashing %s, which the block index does not know", path)
    name = f"{PUT_PREFIX}{path.name}"
    with path.open("rb") as stream:
        cid, _ = enter_blocks(stream, index, name)
    if cid == path.name:
        index.rename(name, cid)
    else:
        log.warning("%s is not the file of its name, or was chunked with other settings: moved aside", path)
        index.forget(name)
        move_aside(path, index)


def _is_cid(name: str) -> bool:
    """Whether a file's name is a CIDv0."""
    try:
        parse_cid(name)
    except InvalidCid:
        return False
    return True

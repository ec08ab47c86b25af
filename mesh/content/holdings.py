"""What a store says about itself: snapshots, in bytes of the files' content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int | None], None]
"""Told how far a long piece of work is: bytes done, and bytes in all or None where nobody knows."""


@dataclass(frozen=True, kw_only=True)
class StoreEntry:
    """A file held. `used` is when it was last read, served or put (Unix time, seconds); `pins` are the labels."""

    cid: str
    size: int
    used: float
    pins: frozenset[str]


@dataclass(frozen=True, kw_only=True)
class Usage:
    """How much is held. `bytes` counts what is being written, fetched or set aside, too; `quota` None is no bound."""

    files: int
    bytes: int
    pinned_bytes: int
    quota: int | None


@dataclass(frozen=True, kw_only=True)
class EvictionReport:
    """What was deleted to make room: the files, and all bytes (remains of broken fetches count in these only)."""

    cids: tuple[str, ...]
    bytes: int


@dataclass(frozen=True, kw_only=True)
class IntegrityReport:
    """What hashing the whole store found: how much was looked at, and which files are not what their names say."""

    files: int
    bytes: int
    damaged: tuple[str, ...]

"""A small disk of its own for a robot of a test, which can be filled."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

FILLER: Final = "filler"
PIECE: Final = 64 * 1024
"""Bytes that are written at a time."""


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of `size` bytes in memory at a new folder. Skips the test where that is not allowed."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("a robot gets a disk of its own only on Linux, and as root")
    folder.mkdir()
    options = f"size={size},mode=700"
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"a robot can't get a disk of its own here: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Meanwhile the disk has no byte left."""
    filler = folder / FILLER
    try:
        with filler.open("wb", buffering=0) as file:
            while True:
                try:
                    file.write(bytes(PIECE))
                except OSError:  # ENOSPC
                    break
        yield
    finally:
        filler.unlink()

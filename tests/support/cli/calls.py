"""Calls of `aira objective` in this process, and the error of a refused one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from click.testing import CliRunner

from mesh.cli import main

if TYPE_CHECKING:
    from pathlib import Path

    from click.testing import Result


def call(*words: str | Path, given: bytes | None = None) -> Result:
    return CliRunner().invoke(main, ["objective", *map(str, words)], input=given)

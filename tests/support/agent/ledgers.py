"""A ledger in a folder of the test's own."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING

import pytest

from mesh.agent.ledger import Ledger
from schemas import cid_of_bytes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

RESULT = cid_of_bytes(b"a recording")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "ledger.sqlite"


@pytest.fixture
async def ledger(path: Path) -> AsyncIterator[Ledger]:
    async with Ledger(path) as opened:
        yield opened


def mark_as_version(path: Path, version: int) -> None:
    """Have the ledger at that path say that it is of another format."""
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version = {version}")
    database.close()

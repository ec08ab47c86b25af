"""Fixtures for the tests of the command line."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tests.support.cli.served_chain import ServedChain
from tests.support.peers import require

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedChain]:
    """A served chain with the contracts, and people with money; a module's tests share it."""
    with ServedChain(tmp_path_factory.mktemp("served")) as served:
        yield served


@pytest.fixture
def on_path(tmp_path: Path) -> dict[str, str]:
    """Variables with which anvil is on the path."""
    folder = tmp_path / "programs"
    folder.mkdir()
    (folder / "anvil").symlink_to(require("anvil"))
    return {"PATH": f"{folder}:{os.environ['PATH']}"}

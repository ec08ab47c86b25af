"""Stores and sessions for each test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import zenoh

from mesh.content import Store
from tests.support.routers import EmbeddedRouter, client_config

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store, for the side that fetches."""
    with Store(tmp_path / "store") as opened:
        yield opened


@pytest.fixture
def holder_store(tmp_path: Path) -> Iterator[Store]:
    """An empty store, for the side that serves."""
    with Store(tmp_path / "holder") as opened:
        yield opened


@pytest.fixture
def session(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The session of the side that fetches."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


@pytest.fixture
def other_session(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """The session of the side that serves."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened


@pytest.fixture
def third_session(router: EmbeddedRouter) -> Iterator[zenoh.Session]:
    """A third session."""
    with zenoh.open(client_config(router.endpoint)) as opened:
        yield opened

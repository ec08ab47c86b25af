"""A market with a robot and a person's signer, for each test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.mcp.world import World

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from mesh.testing import Market


@pytest.fixture
async def world(market: Market, tmp_path: Path) -> AsyncIterator[World]:
    async with World(market, tmp_path) as world:
        yield world

"""The pytest plugin: the fixtures `market` and `market_chain`, there without an import.

Every run of pytest loads it where the package is installed, so it imports what they need when they are used.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

try:
    from pytest_asyncio import fixture as asynchronous
except ImportError:  # then pytest says that it can't run asynchronous fixtures
    asynchronous = pytest.fixture  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from mesh.testing import Market, MarketChain


@pytest.fixture(scope="session")
def market_chain() -> Iterator[MarketChain]:
    """The chain that the markets of a run share; it takes a second or two."""
    import asyncio

    from mesh.testing import MarketChain

    with asyncio.Runner() as runner:
        chain = runner.run(MarketChain().__aenter__())
        try:
            yield chain
        finally:
            runner.run(chain.__aexit__())


@asynchronous
async def market(market_chain: MarketChain) -> AsyncIterator[Market]:
    """A market of this test's own; when the test fails, pytest shows what its agents logged."""
    from mesh.testing import Market

    ours = logging.getLogger("mesh")
    before = ours.level
    ours.setLevel(before or logging.INFO)
    try:
        async with Market(market_chain) as opened:
            yield opened
    finally:
        ours.setLevel(before)

"""A market, a robot that drives, and a person with a policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.signer.signers import Driver, Person, short_folder

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from mesh.testing import Market


@pytest.fixture
def folder() -> Iterator[Path]:
    yield from short_folder()


@pytest.fixture
async def person(market: Market, folder: Path) -> AsyncIterator[Person]:
    async with Person(market, folder, market.chain.new_account()) as person:
        yield person


@pytest.fixture
async def driver(market: Market, folder: Path) -> AsyncIterator[Driver]:
    driver = Driver(folder)
    async with market.robot(driver.agent):
        yield driver

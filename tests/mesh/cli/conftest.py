"""Fixtures for the tests of the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.cli.chains import Town
from tests.support.market import founded, place

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["founded", "place"]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Town]:
    """A served chain with the contracts, and people with money; a module's tests share it."""
    with Town(tmp_path_factory.mktemp("town")) as founded:
        yield founded

"""Fixtures for the tests of the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.mesh.cli.served_chain import ServedChain
from tests.support.market import founded, place

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["founded", "place"]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedChain]:
    """A served chain with the contracts, and people with money; a module's tests share it."""
    with ServedChain(tmp_path_factory.mktemp("served")) as served:
        yield served

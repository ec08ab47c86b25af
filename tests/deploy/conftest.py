"""Fixtures for deployments: the engine, and the images of this tree, built once for all tests of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.containers import Engine, engine
from tests.support.deployment import Images

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["engine"]


@pytest.fixture(scope="session")
def images(engine: Engine, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Images]:
    """The images of this tree."""
    built = Images.build(engine, tmp_path_factory.mktemp("images"))
    yield built
    built.forget()

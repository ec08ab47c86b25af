"""Fixtures for deployments: the engine, and the images of this tree, built once for all tests of a run."""

from __future__ import annotations

import pytest

from tests.support.containers import Engine, engine
from tests.support.deployment import Images

__all__ = ["engine"]


@pytest.fixture(scope="session")
def images(engine: Engine) -> Images:
    """The images of this tree."""
    return Images.build(engine)

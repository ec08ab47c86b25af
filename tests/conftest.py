"""Fixtures for all tests: real servers, each test's own unless said otherwise (see `tests.support`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.ipfs import JsIpfs
from tests.support.nodes import Anvil
from tests.support.routers import EmbeddedRouter, Zenohd

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Share the tests out in our way where whole files are asked for, as `make test` does."""
    if config.getoption("dist") != "loadfile":
        return None
    from tests.support.sharing import Sharing

    return Sharing(config, log)


@pytest.fixture
def router() -> Iterator[EmbeddedRouter]:
    """A Zenoh router inside this process."""
    with EmbeddedRouter() as running:
        yield running


@pytest.fixture
def zenohd() -> Iterator[Zenohd]:
    """The stand-alone Zenoh router."""
    with Zenohd() as running:
        yield running


@pytest.fixture
def anvil() -> Iterator[Anvil]:
    """An EVM node with a new chain."""
    with Anvil() as running:
        yield running


@pytest.fixture(scope="session")
def js_ipfs() -> Iterator[JsIpfs]:
    """A js-ipfs daemon that all tests of a run share: it takes seconds to start, so tests use topics of their own."""
    with JsIpfs() as running:
        yield running

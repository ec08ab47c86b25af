"""Fixtures: each generation's market on each chain, put back after every test to what it was."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.ci import IN_CI
from tests.support.contracts.chains import py_evm, remote
from tests.support.contracts.market import Market
from tests.support.contracts.suite import Suite
from tests.support.nodes import Anvil

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.support.contracts.chains import Chain


@pytest.fixture(scope="package")
def chain() -> Iterator[Chain]:
    """A chain for all tests of the package: anvil in CI, where only gas and histories are py-evm's."""
    if IN_CI:
        with Anvil() as node:
            yield remote(node.url, node.private_keys)
    else:
        yield py_evm()


@pytest.fixture(scope="package")
def markets(chain: Chain) -> dict[int, Market]:
    """The contracts of their own for each generation."""
    return {generation: Market(Suite(chain), generation) for generation in (3, 5)}


@pytest.fixture
def undone(chain: Chain) -> Iterator[None]:
    """Every change that the test makes to the chain is undone."""
    before = chain.snapshot()
    yield
    chain.revert(before)


@pytest.fixture(params=[3, 5])
def market(request: pytest.FixtureRequest, markets: dict[int, Market], undone: None) -> Market:
    """Each generation's market."""
    return markets[request.param]


@pytest.fixture
def third(markets: dict[int, Market], undone: None) -> Market:
    """The market of generation 3."""
    return markets[3]


@pytest.fixture
def fifth(markets: dict[int, Market], undone: None) -> Market:
    """The market of generation 5."""
    return markets[5]


@pytest.fixture(scope="package")
def shared_suite(chain: Chain) -> Suite:
    """The contracts without any use of them."""
    return Suite(chain)


@pytest.fixture
def suite(shared_suite: Suite, undone: None) -> Suite:
    """The contracts, without a lighthouse."""
    return shared_suite

"""Fixtures for all tests: real servers, each test's own unless said otherwise (see `tests.support`)."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import tempfile
from collections import Counter
from typing import TYPE_CHECKING, Final

import pytest
from hypothesis import HealthCheck, settings

from tests.support.ci import IN_CI
from tests.support.nodes import Anvil
from tests.support.ports import hold_unreachable_ports
from tests.support.routers import EmbeddedRouter, Zenohd

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from mesh.testing import MarketChain
    from tests.support.market import Place

settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
gc.disable()  # until all tests are collected: they stay, and looking through them takes a third of that time

ALTERNATIVES: Final = frozenset({"anvil", "zenohd"})
"""Parameters that name a second implementation of what another parameter of the same test names already."""

MEASURED: Final = ("tests/schemas/", "tests/mesh/")
"""Whose tests measure coverage: those of the packages that have a bar for it."""


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Give the run a temporary folder of its own: what Chromium and ROS leave behind there goes with it."""
    if hasattr(config, "workerinput"):
        return
    before, here = tempfile.gettempdir(), tempfile.mkdtemp(prefix="aira-")
    # That of `tmp_path` stays where it was: the paths of sockets must be short.
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", before)
    os.environ["TMPDIR"] = tempfile.tempdir = here
    # Last of all that happens at exit: others, such as ROS, remove what they left there before.
    atexit.register(shutil.rmtree, here, ignore_errors=True)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Keep all processes of a long run from ports that can't be reached."""
    is_worker = hasattr(session.config, "workerinput")
    if not is_worker and (IN_CI or session.config.getoption("numprocesses", None)):
        hold_unreachable_ports()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """One value of `in_turn` parameters; outside CI also one of `sample`, one EVM, one router, and no `full` tests."""
    groups: dict[tuple[object, ...], list[pytest.Item]] = {}
    for item in items:
        if IN_CI or not _is_only_in_ci(item):
            groups.setdefault(_without_samples(item), []).append(item)
    sampled_before: Counter[object] = Counter()
    kept = set[pytest.Item]()
    for (path, *_), group in groups.items():
        kept.add(group[sampled_before[path] % len(group)])
        sampled_before[path] += len(group) > 1
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_collection_finish() -> None:
    """Collect garbage from now on, without looking at the tests."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Run whole files in each process, the longest first, with `--dist loadfile` (as `make test` does)."""
    if config.getoption("dist") != "loadfile":
        return None
    from tests.support.scheduling import LongestFirst

    return LongestFirst(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Measure no coverage in a test of another package or in one that only CI runs: measuring doubles its time."""
    plugin = item.config.pluginmanager.getplugin("_cov")
    measures = plugin.cov_controller if plugin else None
    if measures is None or (item.nodeid.startswith(MEASURED) and not _is_only_in_ci(item)):
        return (yield)
    measures.pause()
    try:
        return (yield)
    finally:
        measures.resume()


@pytest.fixture
def router() -> Iterator[EmbeddedRouter]:
    """A Zenoh router inside this process."""
    with EmbeddedRouter() as running:
        yield running


@pytest.fixture
async def place(market_chain: MarketChain, router: EmbeddedRouter, tmp_path: Path) -> AsyncIterator[Place]:
    """A place of this test's own, for tests that need the parts of a market; `market` is the fixture of the kit."""
    from tests.support.market import Place

    async with Place(market_chain, router.endpoint, tmp_path) as opened:
        yield opened


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


def _without_samples(item: pytest.Item) -> tuple[object, ...]:
    """File, name and parameters of a test, without those parameters of which one value is enough."""
    marks = ("in_turn",) if IN_CI else ("in_turn", "sample")
    sampled = {name for mark in marks for marker in item.iter_markers(mark) for name in marker.args}
    call = getattr(item, "callspec", None)
    if call is None or not sampled:
        return item.path, item.nodeid
    rest = sorted((name, id(value)) for name, value in call.params.items() if name not in sampled)
    return item.path, item.nodeid.partition("[")[0], *rest


def _is_only_in_ci(item: pytest.Item) -> bool:
    """Whether `item` is `full`, or one with an alternative among its parameters."""
    call = getattr(item, "callspec", None)
    values = call.params.values() if call is not None else ()
    return item.get_closest_marker("full") is not None or any(
        isinstance(value, str) and value in ALTERNATIVES for value in values
    )

"""Fixtures for the tests of the doctor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.support.cli.served_chain import ServedChain
from tests.support.doctor.machines import Machine
from tests.support.sites import Site

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedChain]:
    """A served chain with the contracts, and funded accounts with private files."""
    with ServedChain(tmp_path_factory.mktemp("town")) as founded:
        for file in (founded.folder / "password", *(person.keyfile for person in founded.people.values())):
            file.chmod(0o600)
        yield founded


@pytest.fixture
def machine(town: ServedChain, router: EmbeddedRouter, tmp_path: Path) -> Machine:
    return Machine(town, router.endpoint, tmp_path)


@pytest.fixture
def site(tmp_path: Path) -> Site:
    (tmp_path / "one").mkdir()
    return Site(tmp_path / "one")

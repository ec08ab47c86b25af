"""Settings of the property tests: a busy machine is no reason to fail."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

from tests.support.ci import EXAMPLES

if TYPE_CHECKING:
    from collections.abc import Iterator

settings.register_profile("schemas", max_examples=EXAMPLES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("schemas")


@pytest.fixture(autouse=True, scope="module")
def recursion_limit() -> Iterator[None]:
    """Python's own limit, which libraries of other tests in this process may have raised."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(min(before, 1_000))
    yield
    sys.setrecursionlimit(before)

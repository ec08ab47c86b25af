"""Each cell of the crash matrix: a fault at a point of a job, after which it is paid once or refunded.

`CRASH_CELLS` chooses: `all` (`make crash-test`), `sample` (CI), or words of the cells' names,
separated by commas.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from functools import cache
from typing import TYPE_CHECKING, Final

import pytest

from tests.crashes.market import CrashMarket
from tests.crashes.matrix import CELLS, FAULTS, JURY_POINTS, POINTS, SHARED, Cell

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SAMPLE: Final = (
    "provider-kill-",
    "provider-disk-",
    "robot-kill-",
    "robot-clock-",
    "validator-kill-",
    "person-kill-",
    "node-reorganise-",
    "jury-provider-kill-",
)
"""The beginnings of the cells of CI, of each the one in the middle."""


def chosen() -> tuple[Cell, ...]:
    """The cells of this run."""
    wanted = os.environ.get("CRASH_CELLS", "")
    if wanted == "all":
        return CELLS
    if wanted == "sample":
        kinds = [[cell for cell in CELLS if cell.name.startswith(start)] for start in SAMPLE]
        return tuple(cells[len(cells) // 2] for cells in kinds)
    return tuple(cell for cell in CELLS if any(words and words in cell.name for words in wanted.split(",")))


@pytest.fixture(scope="module")
def markets() -> Iterator[Callable[[int], CrashMarket]]:
    """The market of a generation."""
    with ExitStack() as stack:
        yield cache(lambda generation: stack.enter_context(CrashMarket(generation)))


if CHOSEN := chosen():

    @pytest.mark.parametrize("cell", CHOSEN, ids=lambda cell: cell.name)
    def test_a_job_survives_the_fault(markets: Callable[[int], CrashMarket], cell: Cell) -> None:
        markets(cell.generation).play(cell)


def test_each_point_is_a_method() -> None:
    """Whoever renames one of them changes the table."""
    for points in (*POINTS.values(), *JURY_POINTS.values()):
        for point in points:
            point.find()


def test_the_table_has_at_least_twelve_points_for_each_role() -> None:
    assert all(len(points) >= 12 for points in POINTS.values())
    assert len(SHARED) >= 12
    assert len({cell.name for cell in CELLS}) == len(CELLS)
    assert {(cell.victim, cell.fault) for cell in CELLS} == {
        (victim, fault) for victim, faults in FAULTS.items() for fault in faults
    }

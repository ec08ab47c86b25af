"""Reducing a failing history: fewer jobs, fewer kinds of faults, faults that stop earlier, fewer faults."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from tests.simulation.fault_plan import KINDS
from tests.simulation.runs import Run, run_in_child

if TYPE_CHECKING:
    from tests.simulation.deployment import Deployments
    from tests.simulation.history import Report

LASTS: Final = (10, 20, 40, 80, 160)
"""Seconds after which faults stop, the shortest first."""


class Shrinking:
    """The search for the smallest run that violates the same invariant; it takes `most` runs."""

    def __init__(self, deployments: Deployments, run: Run, *, most: int) -> None:
        self._deployments = deployments
        self._left = most
        self.run = run
        self.report = self._again(run)
        self.runs = 1

    def _again(self, run: Run) -> Report:
        return run_in_child(self._deployments, run)

    def _try(self, run: Run) -> bool:
        """Take a run if it still fails in the same way."""
        if self._left <= 0 or run == self.run:
            return False
        self._left, self.runs = self._left - 1, self.runs + 1
        report = self._again(run)
        if not _kinds(report) & _kinds(self.report):
            return False
        self.run, self.report = run, report
        return True

    def shrink(self) -> Run:
        """The smallest run that was found."""
        if not self.report.violations:
            return self.run
        for jobs in range(1, self.run.jobs):
            if self._try(replace(self.run, jobs=jobs)):
                break
        kinds = KINDS if self.run.only is None else sorted(self.run.only)
        for kind in kinds:
            self._try(replace(self.run, without=self.run.without | {kind}))
        for lasts in LASTS:
            if self._try(replace(self.run, lasts=float(lasts))):
                break
        self._leave_out_faults()
        return self.run

    def _leave_out_faults(self) -> None:
        """Leave out halves, quarters and so on of the faults, as long as the invariant is still violated."""
        size = self.report.drawn
        while size >= 1 and self._left > 0:
            start = 0
            while start < self.report.drawn and self._left > 0:
                part = frozenset(range(start, min(start + size, self.report.drawn)))
                if not part <= self.run.left_out:
                    self._try(replace(self.run, left_out=self.run.left_out | part))
                start += size
            size //= 2


def _kinds(report: Report) -> set[str]:
    """The invariants that were violated."""
    return {violation.partition(":")[0] for violation in report.violations}

"""A contract that names a validator: what its jurors have reported, what is missing, and how it is shown to people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mesh.agent.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from schemas import Liability
    from schemas.verdicts import ValidatorReport


@dataclass(eq=False)
class JudgedContract:
    """A liability that names a validator, and what is known of its verdict."""

    liability: Liability
    reports: dict[str, ValidatorReport] = field(default_factory=dict)
    """The first report of each juror."""
    listeners: list[Callable[[ValidatorReport], object]] = field(default_factory=list)
    quorum: int = 0
    """How many jurors must judge alike; 0 until it was read."""
    jurors: int = 0

    def votes(self, *, success: bool) -> int:
        """How many jurors have judged so."""
        return sum(report.success is success for report in self.reports.values())

    @property
    def agreed(self) -> int:
        """The most jurors that have judged alike."""
        return max(self.votes(success=True), self.votes(success=False))

    @property
    def is_judged(self) -> bool:
        """Whether enough jurors have judged alike: a provider, or the juror itself, ends the contract."""
        return 0 < self.quorum <= self.agreed

    @property
    def is_split(self) -> bool:
        """Whether the jurors that have not judged yet can't bring either verdict to the quorum."""
        return self.agreed + self.jurors - len(self.reports) < self.quorum

    def add(self, report: ValidatorReport) -> bool:
        """Remember a juror's first report; False if there is one."""
        if report.juror in self.reports:
            return False
        self.reports[report.juror] = report
        return True


def verdict_words(report: ValidatorReport) -> str:
    """How a juror judged, and why, in one line. The reasons are the juror's own words."""
    if report.success:
        return "the work counts"
    return f"the work does not count: {_reasons(report, with_codes=True)}"


def refusal(reports: Iterable[ValidatorReport]) -> tuple[str, str] | None:
    """Why a juror refused work that the promisor claims to have done: a line of text, and its first code."""
    refused = next((one for one in reports if one.claimed and not one.success), None)
    if refused is None:
        return None
    return f"the validator judged that the work does not count: {_reasons(refused)}", code_of(refused)


def _reasons(report: ValidatorReport, *, with_codes: bool = False) -> str:
    found = [
        f"{one.detail} ({one.code})" if with_codes and one.detail else one.detail or one.code for one in report.failures
    ]
    return "; ".join(found) or ("no reason is given" if report.claimed else "the promisor claims no success")


def code_of(report: ValidatorReport) -> str:
    """The code of the first reason why the work does not count; empty if it counts."""
    return "" if report.success else next((one.code for one in report.failures), "not-done")


def judged_progress(found: ValidatorReport, judged: JudgedContract) -> Progress:
    """The progress that a report is."""
    votes, needed = judged.votes(success=found.success), judged.quorum
    return Progress(
        kind="judged",
        agent=found.juror,
        code=code_of(found),
        detail=verdict_words(found),
        position=votes,
        total=needed,
    )

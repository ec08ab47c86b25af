"""The tables of recordings in docs/reference/tampered-recordings.md: `python -m tests.support.validator.tables`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from tests.support.validator.honest import KINDS
from tests.support.validator.lamps import FinishedJob, contract, order
from tests.support.validator.tampered_claims import tamperings
from tests.support.validator.tampering import Others

if TYPE_CHECKING:
    from collections.abc import Iterable

PAGE: Final = Path(__file__).parents[3] / "docs" / "reference" / "tampered-recordings.md"


def tampered_table(folder: Path) -> str:
    """Each kind of tampering, its verdict, and the reason that is found."""
    objective = order(folder / "objective.mcap")
    any_job = FinishedJob(contract("any", objective), objective, objective, b"", 0, 0)
    kinds = tamperings(Others(any_job, any_job, any_job))
    return _table(("tampering", "verdict", "reason"), ((one.kind, "refunded", f"`{one.code}`") for one in kinds))


def honest_table() -> str:
    """Each kind of honest job, how many there are, and the verdict."""
    return _table(("fault", "jobs", "verdict"), ((one.kind, str(one.jobs), "paid") for one in KINDS))


def in_page(page: str, first: str) -> str:
    """The table of a page whose first heading is that one; empty if there is none."""
    lines = page.splitlines()
    begin = next((number for number, line in enumerate(lines) if line.startswith(f"| {first} |")), len(lines))
    end = next((number for number in range(begin, len(lines)) if not lines[number].startswith("|")), len(lines))
    return "\n".join(lines[begin:end])


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("| --- ", "|---").replace("--- |", "---|")


if __name__ == "__main__":
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as name:
        print(tampered_table(Path(name)), honest_table(), sep="\n\n")

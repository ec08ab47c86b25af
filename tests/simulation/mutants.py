"""The search for planted bugs: histories with each of them, until an invariant is violated that holds without it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tests.simulation.deployment import ON_MODEL
from tests.simulation.mutations import CANDIDATES, MUTATIONS
from tests.simulation.runs import Run, run_in_child
from tests.simulation.scheduler import REAL_TIME

if TYPE_CHECKING:
    from tests.simulation.deployment import Deployments
    from tests.simulation.mutations import Mutation

ROW = "{:<72} {:>5} {:>5} {:>6}  {}"


def find_mutants(deployments: Deployments, seed: int, name: str, *, jobs: int = 0) -> bool:
    """Search for each bug with `name` in its name, print a table, and return whether all were found.

    In histories of so many `jobs`, or of as many as each bug says.
    """
    chosen = [one for one in (*MUTATIONS, *(CANDIDATES if name else ())) if name in one.name]
    chosen = [replace(one, jobs=jobs or one.jobs) for one in chosen]
    for mutation in chosen:
        mutation.source()
    began, missed = REAL_TIME(), 0
    print(ROW.format("planted bug", "seeds", "found", "s", "violated"), flush=True)
    for mutation in chosen:
        at = REAL_TIME()
        found, violated = _search(deployments, mutation, seed)
        missed += not found
        said = str(found) if found else "NO"
        print(ROW.format(mutation.name, mutation.seeds, said, round(REAL_TIME() - at), violated), flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} planted bugs found in {REAL_TIME() - began:.0f} s", flush=True)
    return not missed


def _search(deployments: Deployments, mutation: Mutation, seed: int) -> tuple[int, str]:
    """With which of its seeds a bug is found (0: with none), and the invariant that is violated."""
    only = frozenset(mutation.faults.split(","))
    for attempt in range(mutation.seeds):
        run = Run(seed + attempt, mutation.jobs, only, chain=ON_MODEL)
        report = run_in_child(deployments, Run(run.seed, run.jobs, only, chain=ON_MODEL, plant=mutation.name))
        if report.violations and not run_in_child(deployments, run).violations:
            return attempt + 1, report.violations[0].partition(":")[0]
    return 0, ""

"""The command line of the simulation."""

from __future__ import annotations

import _thread
import argparse
import concurrent.futures
import concurrent.futures.thread as executors
import json
import logging
import os
import subprocess
import sys
import traceback
from asyncio import Queue
from collections import Counter
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any, Final, NoReturn

from tests.simulation import history, router, threads
from tests.simulation.history import Report
from tests.simulation.scheduler import REAL_TIME, SECOND

router.install(lambda: history.CURRENT[-1])  # type: ignore[arg-type,return-value]

from mesh.chain.web3_provider import ReliableProvider  # noqa: E402, F401
from tests.simulation.deployment import ON_EVM, ON_MODEL, Deployments  # noqa: E402
from tests.simulation.faults import FaultPlan  # noqa: E402
from tests.simulation.mutations import CANDIDATES, MUTATIONS, SEEDS, Mutation  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


JOBS: Final = 6
"""Jobs in one history, at most."""
MUTANT_JOBS: Final = 2
"""Jobs in a history with a planted bug."""


def main(arguments: Sequence[str]) -> None:
    """Run histories, and print what happened. Ends with 1 if an invariant was violated."""
    options = _options(arguments)
    executors_module: Any = executors
    executors_module._global_shutdown_lock = _thread.RLock()  # shared by all processes: never let one wait for it
    threads.number_in_sets(Queue, concurrent.futures.Future)
    began = REAL_TIME()
    deployed = Deployments(options.chain)
    if options.mutants:
        _find_mutants(deployed, options)
    total = Report(options.seed)
    for jobs, report in _histories(deployed, options):
        _add(total, report)
        if report.violations:
            _print_failure(report, jobs, options)
        elif not options.json:
            print(f"seed {report.seed}: {report.jobs} jobs, {report.paid} paid", flush=True)
        if options.seconds and REAL_TIME() - began > options.seconds:
            break
        if report.violations and not options.keep_going:
            break
    total.real_s = round(REAL_TIME() - began, 3)
    if options.json:
        print(json.dumps(asdict(total)), flush=True)
    else:
        _print_total(total)
    sys.stdout.flush()
    os._exit(1 if total.violations else 0)


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='make simulate ARGS="…"', description=__doc__)
    parser.add_argument("--seed", type=int, default=None, help="the seed of the first history; a new one by default")
    parser.add_argument("--jobs", type=int, default=JOBS, help=f"jobs in all; a history has up to {JOBS}")
    parser.add_argument("--seconds", type=float, default=0.0, help="begin no history after so many real seconds")
    parser.add_argument("--json", action="store_true", help="print one object at the end")
    parser.add_argument("--trace", action="store_true", help="print what happened in each history")
    parser.add_argument("--log", action="store_true", help="print what the processes log, with their time and name")
    parser.add_argument("--switches", metavar="FILE", help="write each switch of threads to a file")
    parser.add_argument("--mutants", action="store_true", help="plant each bug in turn, and search until it is found")
    parser.add_argument("--mutant", default="", help="only planted bugs whose name contains this")
    parser.add_argument(
        "--chain", choices=(ON_MODEL, ON_EVM), default=None, help="what runs the contracts; by default the seed chooses"
    )
    parser.add_argument("--keep-going", action="store_true", help="do not stop at the first failure")
    parser.add_argument("--only", default="", help="the kinds of faults, with commas; `none` for none")
    parser.add_argument("--without", default="", help="kinds of faults that do not happen, with commas")
    options = parser.parse_args(arguments)
    if options.seed is None:
        options.seed = int.from_bytes(os.urandom(4), "big")
        print(f"seed {options.seed}", file=sys.stderr)
    names = {field.name for field in fields(FaultPlan)}
    only, without = (frozenset(filter(None, text.split(","))) for text in (options.only, options.without))
    if (only | without) - names - {"none"}:
        parser.error(f"faults are {', '.join(sorted(names))}")
    options.only, options.without = only or None, without
    if options.log:
        _print_logs()
    return options


def _print_logs() -> None:
    class SimulatedHandler(logging.StreamHandler[Any]):
        def createLock(self) -> None:  # noqa: N802
            self.lock = None  # where a simulated lock is taken, threads may switch

        def format(self, record: logging.LogRecord) -> str:
            scheduler = threads.scheduler()
            process = scheduler.process.name if scheduler.process else "-"
            return f"{scheduler.now_ns / SECOND:.3f} {process} {record.levelname} {record.name}: {record.getMessage()}"

    logging.getLogger("mesh").setLevel(logging.INFO)
    logging.getLogger("mesh").addHandler(SimulatedHandler(sys.stdout))


def _histories(deployed: Deployments, options: argparse.Namespace) -> Iterator[tuple[int, Report]]:
    left, seed = options.jobs, options.seed
    while left > 0:
        jobs = min(left, JOBS)
        yield jobs, _in_child(deployed, seed, jobs, options)
        left, seed = left - jobs, seed + 1


def _find_mutants(deployed: Deployments, options: argparse.Namespace) -> NoReturn:
    """Plant each bug in turn, until a history violates an invariant that holds without it. Ends with 1 if one hides."""
    missed, chosen = (
        0,
        [one for one in (*MUTATIONS, *(CANDIDATES if options.mutant else ())) if options.mutant in one.name],
    )
    options.without = frozenset()
    for mutation in chosen:
        mutation.source()
    for mutation in chosen:
        options.only = frozenset(mutation.faults.split(","))
        for attempt in range(1, SEEDS + 1):
            seed = options.seed + attempt - 1
            report = _in_child(deployed, seed, MUTANT_JOBS, options, mutation)
            if report.violations and not _in_child(deployed, seed, MUTANT_JOBS, options).violations:
                print(f"found with seed {report.seed} ({attempt}): {mutation.name}: {report.violations[0]}", flush=True)
                break
        else:
            missed += 1
            print(f"NOT FOUND within {SEEDS} seeds: {mutation.name}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} planted bugs found", flush=True)
    os._exit(1 if missed else 0)


def _in_child(
    deployed: Deployments, seed: int, jobs: int, options: argparse.Namespace, mutation: Mutation | None = None
) -> Report:
    """Run a history in a process of its own: nothing is left of it for the next one."""
    kind = ON_MODEL if mutation is not None and options.chain is None else deployed.kind(seed)
    market = deployed.market(kind)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        code = 1
        try:
            if mutation is not None:
                mutation.apply()
            plan = history.plan_of(seed, only=options.only, without=options.without)
            report, lines = history.run_history(market, seed, jobs, plan, switches=options.switches)
            if options.trace:
                print(plan, *lines, sep="\n", flush=True)
            with os.fdopen(writing, "w") as pipe:
                json.dump(asdict(report), pipe)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    if not said:
        return Report(seed, violations=["history-failed: the process of the history ended"])
    report = Report(**json.loads(said))
    report.chains = {kind: 1}
    return report


def _add(total: Report, report: Report) -> None:
    for name in ("jobs", "paid", "refunded", "lost", "paid_twice"):
        setattr(total, name, getattr(total, name) + getattr(report, name))
    total.simulated_s = round(total.simulated_s + report.simulated_s, 3)
    total.cpu_s = round(total.cpu_s + report.cpu_s, 3)
    total.violations += [f"seed {report.seed}: {violation}" for violation in report.violations]
    total.markets = dict(sorted((Counter(total.markets) + Counter(report.markets)).items()))
    total.chains = dict(sorted((Counter(total.chains) + Counter(report.chains)).items()))
    total.faults = dict(sorted((Counter(total.faults) + Counter(report.faults)).items()))
    total.trace = report.trace


def _print_failure(report: Report, jobs: int, options: argparse.Namespace) -> None:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    only = f" --only {','.join(sorted(options.only))}" if options.only else ""
    only += f" --without {','.join(sorted(options.without))}" if options.without else ""
    print(f"FAILED at commit {commit.stdout.strip()}; replay with", file=sys.stderr)
    print(f'    make simulate ARGS="--seed {report.seed} --jobs {jobs}{only} --trace"', file=sys.stderr)
    for violation in report.violations:
        print(f"  {violation}", file=sys.stderr)
    sys.stderr.flush()


def _print_total(total: Report) -> None:
    ratio = total.simulated_s / total.cpu_s if total.cpu_s else 0
    print(
        f"{total.jobs} jobs, {total.paid} paid, {total.refunded} refunded, {total.lost} lost, {total.paid_twice} paid"
        f" twice, {len(total.violations)} violations; {total.simulated_s:.0f} simulated seconds in {total.real_s:.0f} s"
        f" ({total.cpu_s:.0f} s of CPU, {ratio:.0f} times faster than real time)"
    )

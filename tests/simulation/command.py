"""The command line of the simulation."""

from __future__ import annotations

import _thread
import argparse
import concurrent.futures
import concurrent.futures.thread as executors
import json
import logging
import os
import random
import signal
import subprocess
import sys
from asyncio import Queue
from collections import Counter
from contextlib import closing, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tests.simulation import history, memo, router, threads
from tests.simulation.history import Report
from tests.simulation.scheduler import REAL_TIME, SECOND

router.install(lambda: history.CURRENT[-1])  # type: ignore[arg-type,return-value]

from mesh.chain.rpc import RpcClient  # noqa: E402, F401
from tests.simulation.deployment import CROWDED_JOBS, JOBS, ON_EVM, ON_MODEL, Deployments  # noqa: E402
from tests.simulation.fault_plan import KINDS  # noqa: E402
from tests.simulation.mutants import find_mutants  # noqa: E402
from tests.simulation.runs import Child, Run, Stopped, numbers_in, run_in_children  # noqa: E402
from tests.simulation.shrinking import Shrinking  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


SUMMARY_SECONDS: Final = 60.0


def main(arguments: Sequence[str]) -> None:
    """Run histories, and print what happened. Ends with 1 if an invariant was violated."""
    options = _options(arguments)
    executors_module: Any = executors
    executors_module._global_shutdown_lock = _thread.RLock()  # shared by all processes: never let one wait for it
    threads.number_in_sets(Queue, concurrent.futures.Future)
    memo.install()
    began = REAL_TIME()
    deployed = Deployments(options.chain)
    if options.mutants:
        jobs = options.history_jobs if options.history_jobs > JOBS else 0
        found_all = find_mutants(deployed, options.seed, options.mutant, jobs=jobs)
        sys.stdout.flush()
        os._exit(0 if found_all else 1)
    total = Report(options.seed)
    with suppress(Stopped):
        signal.signal(signal.SIGTERM, lambda number, frame: Child.stop_all())
        _run(deployed, options, total, began)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    total.real_s = round(REAL_TIME() - began, 3)
    _write_summary(total, options.summary)
    if options.json:
        print(json.dumps(asdict(total)), flush=True)
    else:
        _print_total(total)
    sys.stdout.flush()
    os._exit(1 if total.violations else 0)


def _run(deployed: Deployments, options: argparse.Namespace, total: Report, began: float) -> None:
    """Run histories, and add what happened to the total."""
    shown, written = {"trace": options.trace, "switches": options.switches}, began
    with closing(run_in_children(deployed, _histories(options), workers=options.workers, **shown)) as histories:
        for run, report in histories:
            _add(total, report)
            if report.violations:
                _print_failure(report, run)
                if options.shrink:
                    _shrink(deployed, run, options.shrink)
            elif not options.json:
                print(f"seed {report.seed}: {report.jobs} jobs, {report.paid} paid", flush=True)
            total.real_s = round(REAL_TIME() - began, 3)
            if REAL_TIME() - written > SUMMARY_SECONDS:
                written = REAL_TIME()
                _write_summary(total, options.summary)
            if options.seconds and total.real_s > options.seconds:
                break
            if report.violations and not options.keep_going:
                break


def _write_summary(total: Report, path: str) -> None:
    """Write the object of `--json` into a file."""
    if path:
        new = Path(f"{path}.new")
        new.write_text(json.dumps(asdict(total)) + "\n")
        new.replace(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='make simulate ARGS="…"', description=__doc__)
    parser.add_argument("--seed", type=int, default=None, help="the seed of the first history; a new one by default")
    parser.add_argument("--jobs", type=int, default=JOBS, help="jobs in all")
    parser.add_argument("--history-jobs", type=int, default=JOBS, help=f"jobs in a history; above {JOBS}: a long one")
    parser.add_argument("--seconds", type=float, default=0.0, help="begin no history after so many real seconds")
    parser.add_argument("--json", action="store_true", help="print one object at the end")
    parser.add_argument("--summary", default="", metavar="FILE", help="write that object each minute, and at SIGTERM")
    parser.add_argument("--trace", action="store_true", help="print what happened in each history")
    parser.add_argument("--log", action="store_true", help="print what the processes log, with their time and name")
    parser.add_argument("--switches", metavar="FILE", help="write each switch of threads to a file")
    parser.add_argument("--mutants", action="store_true", help="plant each bug in turn, and search until it is found")
    parser.add_argument("--mutant", default="", help="only planted bugs whose name contains this")
    parser.add_argument("--plant", default="", help="plant this bug of mutations.py in all histories")
    parser.add_argument("--shrink", type=int, nargs="?", const=100, default=0, metavar="RUNS", help="reduce failures")
    parser.add_argument("--leave-out", type=numbers_in, default=frozenset(), help="faults by number, such as 0-4,7")
    parser.add_argument("--lasts", type=float, default=None, help="seconds after which all faults stop")
    parser.add_argument(
        "--chain", choices=(ON_MODEL, ON_EVM), default=None, help="what runs the contracts; by default the seed chooses"
    )
    parser.add_argument("--workers", type=int, default=0, help="histories at a time; by default one for each core")
    parser.add_argument("--keep-going", action="store_true", help="do not stop at the first failure")
    parser.add_argument("--only", default="", help="the kinds of faults, with commas; `none` for none")
    parser.add_argument("--without", default="", help="kinds of faults that do not happen, with commas")
    return parser


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.seed is None:
        options.seed = random.SystemRandom().getrandbits(32)  # `os.urandom` is simulated
        print(f"seed {options.seed}", file=sys.stderr)
    if min(options.jobs, options.history_jobs) < 1 or options.workers < 0:
        parser.error("--jobs and --history-jobs are at least 1, --workers at least 0")
    if options.chain == ON_EVM and options.history_jobs >= CROWDED_JOBS:
        parser.error(f"histories of {CROWDED_JOBS} jobs or more have crowded markets, which need --chain {ON_MODEL}")
    if not options.workers:  # what several print would mix
        options.workers = 1 if options.trace or options.log or options.switches else len(os.sched_getaffinity(0))
    only, without = (frozenset(filter(None, text.split(","))) for text in (options.only, options.without))
    if (only | without) - {*KINDS, "none"}:
        parser.error(f"faults are {', '.join(sorted(KINDS))}")
    options.only, options.without = only or None, without
    if options.log:
        _print_logs()
    return options


def _print_logs() -> None:
    class SimulatedHandler(logging.Handler):
        def handle(self, record: logging.LogRecord) -> bool:
            """Without the handler's lock: where a simulated lock is taken, threads may switch."""
            scheduler = threads.scheduler()
            now, process = scheduler.now_ns / SECOND, scheduler.process.name if scheduler.process else "-"
            print(f"{now:.3f} {process} {record.levelname} {record.name}: {record.getMessage()}", flush=True)
            return True

    logging.getLogger("mesh").setLevel(logging.INFO)
    logging.getLogger("mesh").addHandler(SimulatedHandler())


def _histories(options: argparse.Namespace) -> Iterator[Run]:
    left, seed = options.jobs, options.seed
    while left > 0:
        run = Run(
            seed,
            min(left, options.history_jobs),
            options.only,
            options.without,
            options.leave_out,
            options.lasts,
            options.chain or "",
            options.plant,
        )
        yield run
        left, seed = left - run.jobs, seed + 1


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


def _print_failure(report: Report, run: Run) -> None:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    print(f"FAILED at commit {commit.stdout.strip()}; replay with", file=sys.stderr)
    print(f'    make simulate ARGS="{run.arguments()} --trace"', file=sys.stderr)
    for violation in report.violations:
        print(f"  {violation}", file=sys.stderr)
    sys.stderr.flush()


def _shrink(deployments: Deployments, run: Run, most: int) -> None:
    """Reduce a failing history, and print what is left of it."""
    shrinking = Shrinking(deployments, run, most=most)
    before, small = shrinking.report.drawn, shrinking.shrink()
    report = shrinking.report
    print(f"after {shrinking.runs} runs: {small.jobs} jobs, {report.drawn} faults of {before}", file=sys.stderr)
    _print_failure(report, small)


def _print_total(total: Report) -> None:
    ratio = total.simulated_s / total.cpu_s if total.cpu_s else 0
    print(
        f"{total.jobs} jobs, {total.paid} paid, {total.refunded} refunded, {total.lost} lost, {total.paid_twice} paid"
        f" twice, {len(total.violations)} violations; {total.simulated_s:.0f} simulated seconds in {total.real_s:.0f} s"
        f" ({total.cpu_s:.0f} s of CPU, {ratio:.0f} times faster than real time)"
    )

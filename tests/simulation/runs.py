"""What is run: a history, from a few numbers and names, in a process of its own."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import islice
from typing import TYPE_CHECKING, ClassVar, Final, NoReturn

from tests.simulation import history
from tests.simulation.deployment import JOBS, market_plan
from tests.simulation.history import Report
from tests.simulation.mutations import planted

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from tests.simulation.deployment import Deployed, Deployments

MOST_CPU_SECONDS: Final = 60
"""Of a history, and `MOST_CPU_A_JOB` for each of its jobs: ten times as many as the longest ones take."""
MOST_CPU_A_JOB: Final = 15
MOST_REAL_TIMES: Final = 4
"""How many times as many real seconds it may take: one that waits for ever takes no CPU."""


@dataclass(frozen=True)
class Run:
    """A history; the same run is the same to the byte.

    `only` and `without` are kinds of faults, `left_out` numbers of faults, `lasts` the seconds after which faults stop
    (None: as the seed says), `chain` what runs the contracts (empty: as the seed says), `plant` a bug of `mutations`.
    """

    seed: int
    jobs: int
    only: frozenset[str] | None = None
    without: frozenset[str] = frozenset()
    left_out: frozenset[int] = frozenset()
    lasts: float | None = None
    chain: str = ""
    plant: str = ""

    def arguments(self) -> str:
        """The command line's arguments that run it again."""
        words = [f"--seed {self.seed} --jobs {self.jobs}"]
        if self.jobs > JOBS:
            words.append(f"--history-jobs {self.jobs}")
        if self.only is not None:
            words.append(f"--only {','.join(sorted(self.only)) or 'none'}")
        if self.without:
            words.append(f"--without {','.join(sorted(self.without))}")
        if self.left_out:
            words.append(f"--leave-out {ranges(self.left_out)}")
        if self.lasts is not None:
            words.append(f"--lasts {self.lasts:g}")
        if self.chain:
            words.append(f"--chain {self.chain}")
        if self.plant:
            words.append(f"--plant '{self.plant}'")
        return " ".join(words)


def ranges(numbers: frozenset[int]) -> str:
    """Numbers as text, such as 0-4,7; `numbers_in` reads it."""
    words: list[str] = []
    first = last = -2
    for number in [*sorted(numbers), -2]:
        if number == last + 1:
            last = number
            continue
        if first >= 0:
            words.append(f"{first}-{last}" if last > first else str(first))
        first = last = number
    return ",".join(words)


def numbers_in(text: str) -> frozenset[int]:
    """The numbers that `ranges` wrote. Raises `ValueError`."""
    found: set[int] = set()
    for word in filter(None, text.split(",")):
        first, _, last = word.partition("-")
        found.update(range(int(first), int(last or first) + 1))
    return frozenset(found)


def run_in_child(deployments: Deployments, run: Run, *, trace: bool = False, switches: str | None = None) -> Report:
    """Run a history in a process of its own: nothing is left of it for the next one."""
    return Child(deployments, run, trace=trace, switches=switches).report()


def run_in_children(
    deployments: Deployments, runs: Iterable[Run], *, workers: int, trace: bool, switches: str | None
) -> Generator[tuple[Run, Report]]:
    """Run histories, `workers` at a time; what happened in each, in their order."""
    started: deque[Child] = deque()
    left = iter(runs)
    try:
        while True:
            for run in islice(left, workers - len(started)):
                started.append(Child(deployments, run, trace=trace, switches=switches))
            if not started:
                return
            child = started.popleft()
            yield child.run, child.report()
    finally:
        for child in started:
            child.end()


class Stopped(Exception):
    """`Child.stop_all` was called: no more histories."""


class Child:
    """The process of a history. Raises `Stopped` from when all were stopped."""

    running: ClassVar[set[Child]] = set()
    are_stopped: ClassVar[bool] = False

    def __init__(self, deployments: Deployments, run: Run, *, trace: bool, switches: str | None) -> None:
        self.run = run
        self._kind = run.chain or deployments.kind(run.seed, run.jobs)
        market = deployments.market(self._kind, jurors=market_plan(run.seed, run.jobs).jurors)
        self._pipe, writing = os.pipe()
        self._process = os.fork()
        if self._process == 0:
            os.close(self._pipe)
            _play(market, run, writing, trace=trace, switches=switches)
        os.close(writing)
        self.running.add(self)
        if self.are_stopped:
            self._kill()

    @classmethod
    def stop_all(cls) -> None:
        """End all at once. A signal handler may call it: it raises nothing, wherever the signal came."""
        Child.are_stopped = True
        for child in tuple(cls.running):
            child._kill()

    def report(self) -> Report:
        """Wait for its end; what happened."""
        with os.fdopen(self._pipe) as pipe:
            said = pipe.read()
        self._reap()
        if self.are_stopped:
            raise Stopped
        if not said:
            ended = "history-failed: its process ended, or computed too long: something in it never ends"
            return Report(self.run.seed, violations=[ended])
        report = Report(**json.loads(said))
        report.chains = {self._kind: 1}
        return report

    def end(self) -> None:
        """End it at once."""
        self._kill()
        self._reap()

    def _kill(self) -> None:
        os.kill(self._process, signal.SIGKILL)

    def _reap(self) -> None:
        self.running.discard(self)  # first: its number may be that of another process soon
        os.waitpid(self._process, 0)
        shutil.rmtree(history.FOLDER / str(self._process), ignore_errors=True)


def _play(market: Deployed, run: Run, writing: int, *, trace: bool, switches: str | None) -> NoReturn:
    """Run a history in this process, which ends; the report goes into the pipe."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    limit = MOST_CPU_SECONDS + MOST_CPU_A_JOB * run.jobs
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    signal.alarm(MOST_REAL_TIMES * limit)
    try:
        if run.plant:
            planted(run.plant).apply()
        plan = history.plan_of(run.seed, run.jobs, only=run.only, without=run.without)
        plan.lasts = plan.lasts if run.lasts is None else run.lasts
        report, lines = history.run_history(market, run.seed, run.jobs, plan, left_out=run.left_out, switches=switches)
        if trace:
            print(plan, *lines, sep="\n", flush=True)
        # When the run is ended, nobody waits for the report.
        with suppress(BrokenPipeError), os.fdopen(writing, "w") as pipe:
            json.dump(asdict(report), pipe)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)

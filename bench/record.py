"""Runs benchmarks and keeps what they measured in bench/results.json, of which `make docs` makes a page.

    python bench/record.py              # all
    python bench/record.py book rpc     # these

Each result has the day, the commit, the machine and its load in the minute before; what is not run keeps its older one.
A run that fails keeps none, but for one that misses a bar: it has printed what it measured. Exits with 1 for either.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
RESULTS: Final = HERE / "results.json"


def main() -> int:
    """Run from the command line; what to exit with."""
    parser = argparse.ArgumentParser(description="Run benchmarks and keep what they measured in bench/results.json.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(benches())}; by default all")
    names = parser.parse_args().names or benches()
    if unknown := [name for name in names if name not in benches()]:
        parser.error(f"no benchmark {', '.join(unknown)}")
    missed = [name for name in names if not record(name)]
    if missed:
        print(f"failed, or missed a bar: {' '.join(missed)}", file=sys.stderr)
    return 1 if missed else 0


def benches() -> list[str]:
    """The names of all benchmarks."""
    programs = (path for path in sorted(HERE.glob("*.py")) if "__main__" in path.read_text(encoding="utf-8"))
    return [path.stem for path in programs if path.stem != Path(__file__).stem]


def record(name: str) -> bool:
    """Run one benchmark, print what it measured and keep it. Whether it met its bars."""
    load, begun = os.getloadavg()[0], time.monotonic()
    done = subprocess.run(
        [sys.executable, HERE / f"{name}.py", "--json"], stdout=subprocess.PIPE, text=True, check=False
    )
    print(f"{name}: {done.stdout.strip()}", flush=True)
    try:
        measured = json.loads(done.stdout)
    except ValueError:
        return False
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    kept[name] = {
        "day": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": round(load, 1),
        "seconds": round(time.monotonic() - begun),
        "met": done.returncode == 0,
        "measured": measured,
    }
    RESULTS.write_text(json.dumps(dict(sorted(kept.items())), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return done.returncode == 0


def commit() -> str:
    """The commit that is checked out, and whether what is measured differs from it."""
    if not (short := git("rev-parse", "--short=8", "HEAD")):
        return "unknown"
    changed = git("status", "--porcelain", "--", "../schemas", "../mesh", "../bridges", "../contracts")
    return f"{short}, changed" if changed else short


def git(*words: str) -> str:
    """What git prints; nothing outside of a clone."""
    return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=False).stdout.strip()


def machine() -> str:
    """The processor, its cores, and Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    except OSError:
        model = ""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model or platform.machine()}, {cores} cores, {platform.system()}, Python {platform.python_version()}"


if __name__ == "__main__":
    sys.exit(main())

"""How much an installation takes: megabytes of each extra with all that it requires, and seconds to start.

    python bench/install.py [--json]

It reads what is installed beside it, so it asks no registry. It exits with an error above a bar.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

ROOT: Final = Path(__file__).parents[1]
STARTS: Final = {
    "import mesh": ("-c", "import mesh"),
    "aira --help": ("-m", "mesh", "--help"),
    "import mesh.Agent": ("-c", "from mesh import Agent"),
}
BARS: Final = {"import mesh": 0.1, "aira --help": 0.2}
"""Seconds of a processor, beyond those of `python -c pass`."""
TRIES: Final = 7


def project() -> dict[str, list[str]]:
    """The requirements of the base (an empty name) and of each extra, from pyproject.toml."""
    facts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {"": facts["dependencies"], **facts["optional-dependencies"]}


def packages(extra: str, extras: dict[str, list[str]], seen: set[str]) -> None:
    """Add the names of the packages that an extra requires, and of what those require."""
    for text in extras[extra]:
        wanted = Requirement(text)
        if wanted.name == "aira-mesh":
            for other in wanted.extras:
                packages(other, extras, seen)
        else:
            required(wanted, seen)


def required(wanted: Requirement, seen: set[str]) -> None:
    name = wanted.name.lower().replace("_", "-")
    if name in seen:
        return
    try:
        found = distribution(name)
    except PackageNotFoundError:  # for another Python or system
        return
    seen.add(name)
    for text in found.requires or ():
        other = Requirement(text)
        chosen = wanted.extras or {""}
        if other.marker is None or any(other.marker.evaluate({"extra": extra}) for extra in chosen):
            required(other, seen)


def megabytes(names: set[str]) -> float:
    files = {Path(str(file.locate())) for name in names for file in distribution(name).files or ()}
    return sum(file.stat().st_size for file in files if file.is_file() and file.suffix != ".pyc") / 1e6


def seconds(*arguments: str) -> float:
    """Of a processor, the shortest of some runs: so it hardly matters what else the machine does."""
    found = []
    for _ in range(TRIES):
        before = os.times()
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, capture_output=True)
        after = os.times()
        found.append(sum(after[2:4]) - sum(before[2:4]))
    return min(found)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="megabytes of each extra, and seconds to start")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    own = sum(path.stat().st_size for part in ("mesh", "bridges", "schemas") for path in files_of(ROOT / part)) / 1e6
    extras, size, count = project(), {}, {}
    for extra in extras:
        names: set[str] = set()
        packages("", extras, names)
        packages(extra, extras, names)
        size[extra or "base"], count[extra or "base"] = round(own + megabytes(names), 1), len(names)
    empty = seconds("-c", "pass")
    starts = {name: round(seconds(*arguments) - empty, 3) for name, arguments in STARTS.items()}
    results = {"megabytes": size, "packages": count, "seconds": starts}
    if options.json:
        print(json.dumps(results))
    else:
        for name in size:
            print(f"{name:<10} {size[name]:7.1f} MB, {count[name]:3} packages")
        for name, found in starts.items():
            print(f"{name:<18} {found:.3f} s")
    if missed := [f"{name} {starts[name]} s (at most {bar} s)" for name, bar in BARS.items() if starts[name] > bar]:
        sys.exit(f"above the limit: {', '.join(missed)}")


def files_of(folder: Path) -> list[Path]:
    """The files of a package, without what its page is built from."""
    left_out = {"__pycache__", "node_modules", "app"}
    return [path for path in folder.rglob("*") if path.is_file() and not left_out & set(path.parts)]


if __name__ == "__main__":
    main()

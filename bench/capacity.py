"""How much one machine bears: agents on a router, messages through it, devices, orders and jobs of a provider.

The router, the crowd, the publisher and the devices are processes of their own; provider, robot and person of the jobs
share one. What else the machine is busy with counts against it: `load` is the average of the last minute before.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `peers` says where anvil is

from busy import jobs_a_minute, taken_a_second  # noqa: E402
from crowd import devices, filtered, sessions  # noqa: E402
from report import arguments  # noqa: E402

STEPS: Final = (10, 50, 100, 200, 400, 800)
"""Numbers of sessions that are looked at, as far as is asked for."""


def measure(options: Any) -> dict[str, Any]:
    """All of it."""
    load = os.getloadavg()[0]
    return {
        "machine": {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), "load": round(load, 1)},
        "sessions": sessions([step for step in STEPS if step <= options.sessions]),
        "messages": filtered([step for step in (1, 10, 50) if step <= options.sessions], options.messages),
        "devices": devices(options.devices),
        "orders": taken_a_second(options.orders),
        "jobs": jobs_a_minute(options.jobs, options.at_once),
    }


def print_table(figures: dict[str, Any]) -> None:
    """A table for people, of each kind of figures."""
    for name, found in figures.items():
        rows = found if isinstance(found, list) else [found]
        if name == "jobs":
            rows = [{"chain": chain, **row} for chain, row in found.items() if not isinstance(row, str)]
        print(f"\n{name}")
        heads = list(rows[0])
        widths = [max(len(head), *(len(str(row[head])) for row in rows)) for head in heads]
        for cells in (heads, *([str(row[head]) for head in heads] for row in rows)):
            print(
                "  " + "  ".join(cell.replace("_", " ").rjust(width) for cell, width in zip(cells, widths, strict=True))
            )


def main() -> None:
    """Run it."""
    options = arguments(
        "what one machine bears", sessions=200, messages=20_000, devices=8, orders=10_000, jobs=20, at_once=4
    )
    figures = measure(options)
    if options.json:
        print(json.dumps(figures))
    else:
        print_table(figures)


if __name__ == "__main__":
    main()

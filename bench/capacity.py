"""The capacity of one machine: agents on a router, messages through it, devices, orders and jobs of a provider.

Router, agents, publisher, devices, and the roles of the jobs run in processes of their own.
Other load on the machine lowers the results: `load` is the load average of the minute before.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `peers` finds anvil

from one_router import devices, filtered, sessions  # noqa: E402

from common import arguments  # noqa: E402
from load import jobs_per_minute, orders_per_second  # noqa: E402

STEPS: Final = (10, 50, 100, 200, 400, 800)
"""Numbers of sessions to measure, up to the one in the options."""


def measure(options: Any) -> dict[str, Any]:
    """Run all measurements."""
    load = os.getloadavg()[0]
    return {
        "machine": {"cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), "load": round(load, 1)},
        "sessions": sessions([step for step in STEPS if step <= options.sessions]),
        "messages": filtered([step for step in (1, 10, 50) if step <= options.sessions], options.messages),
        "devices": devices(options.devices),
        "orders": orders_per_second(options.orders),
        "jobs": jobs_per_minute(options.jobs, robots=options.robots, at_once=options.at_once),
    }


def print_table(results: dict[str, Any]) -> None:
    """Print a table for each kind of measurement."""
    for name, found in results.items():
        rows = found if isinstance(found, list) else [found]
        print(f"\n{name}")
        heads = list(rows[0])
        widths = [max(len(head), *(len(str(row[head])) for row in rows)) for head in heads]
        for cells in (heads, *([str(row[head]) for head in heads] for row in rows)):
            print(
                "  " + "  ".join(cell.replace("_", " ").rjust(width) for cell, width in zip(cells, widths, strict=True))
            )


def main() -> None:
    """Run the benchmark."""
    options = arguments(
        "the capacity of one machine",
        sessions=200,
        messages=20_000,
        devices=8,
        orders=10_000,
        jobs=100,
        robots=20,
        at_once=40,
    )
    results = measure(options)
    if options.json:
        print(json.dumps(results))
    else:
        print_table(results)


if __name__ == "__main__":
    main()

"""Gas of our contracts, compared with the original ones and with limits; exits with 1 above a limit.

The measurements are those of the contracts' tests; `tests/support/contracts/gas.py` documents their conditions.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import argparse
import json

from tests.support.contracts.gas import GENERATIONS, ROWS, Gas, exceeded, measure


def table(gas: Gas) -> str:
    """The measurements as a table."""
    lines = [f"{'':28}{'ours 5':>9}{'limit':>9}{'original 5':>12}   {'ours 3':>9}{'limit':>9}{'original 3':>12}"]
    for key, row in ROWS.items():
        line = f"{row.label:28}"
        for index, column in enumerate(GENERATIONS.values()):
            ours, bar = (f"{number:,}" if number else "-" for number in (gas[key].get(column), row.bars[index]))
            line += f"{ours:>9}{bar:>9}{row.originals[index]:>12}" + "   " * (index == 0)
        lines.append(line)
    return "\n".join(lines)


def main() -> int:
    """Run from the command line; returns 1 above a limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object: gas by row and generation")
    arguments = parser.parse_args()
    gas = measure()
    print(json.dumps(gas) if arguments.json else table(gas))
    too_high = exceeded(gas)
    for line in too_high:
        print(line, file=sys.stderr)
    return 1 if too_high else 0


if __name__ == "__main__":
    sys.exit(main())

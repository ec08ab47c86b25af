"""How a benchmark says what it found: one JSON object, or a line a figure."""

from __future__ import annotations

import argparse
import json
from typing import Any


def arguments(description: str, **defaults: int | tuple[str, ...]) -> argparse.Namespace:
    """The command line: `--json`, and for each of `defaults` a number, or one of several words, of which the first."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    for name, default in defaults.items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(default, tuple):
            parser.add_argument(option, choices=default, default=default[0])
        else:
            parser.add_argument(option, type=int, default=default)
    return parser.parse_args()


def show(figures: dict[str, Any], *, as_json: bool) -> None:
    """Print the figures."""
    if as_json:
        print(json.dumps(figures))
        return
    width = max(len(name) for name in figures)
    for name, value in figures.items():
        print(f"{name.replace('_', ' '):<{width}}  {value}")

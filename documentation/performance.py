"""The page about performance, from bench/results.json, which `make bench` writes."""

from __future__ import annotations

import ast
import json
from typing import TYPE_CHECKING, Any, Final

from documentation.markdown import escaped
from documentation.staging import ROOT
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Iterator

BENCH: Final = ROOT / "bench"
HEAD: Final = """\
# Performance

`make bench` measures this, and `make bench ARGS="book rpc"` some of it. It fails where a bar is missed, and writes
`bench/results.json`, of which this page is made. Each part says on which day, commit and machine, and how busy that
was: with a load above the number of cores all figures are worse than they are alone.
"""
BARS: Final[dict[str, dict[str, str]]] = {
    "edge": {"memory_mb": "at most: MOST_MEMORY", "start_s": "at most: MOST_START"},
    "install": {f"seconds, {name}": f"at most: BARS[{name}]" for name in ("import mesh", "aira --help")},
    "messages": {"ratio": "at least: BAR"},
    "regions": {"p99_ms": "at most: BAR_MS"},
    "ros1": {"memory_mb": "at most: MOST_MEMORY"},
    "ros2": {"memory_mb": "at most: MOST_MEMORY"},
    "roundtrip": {"ratio": "at most: BAR"},
    "rpc": {
        "per_job": "at most: CALLS_PER_JOB",
        "idle_minute": "at most: IDLE_MINUTE",
        "idle_block": "at most: IDLE_BLOCK",
    },
    "stop": {"p99_ms": "at most: BAR_MS"},
}
"""The bars of figures, each with the constant of its benchmark, which has the number."""


def performance() -> str:
    """The page's text."""
    results = decode_json((BENCH / "results.json").read_bytes())
    return HEAD + "".join(_part(name, run) for name, run in sorted(results.items()))


def _part(name: str, run: dict[str, Any]) -> str:
    source = ast.parse((BENCH / f"{name}.py").read_text(encoding="utf-8"))
    about = [text for text in (ast.get_docstring(source) or "").split("\n\n") if not text.startswith(" ")]
    said = "\n\n".join(about[:2])
    measured = {key: value for key, value in run["measured"].items() if key not in ("bar", "missed")}
    met = "All bars were met." if run["met"] else "**A bar was missed.**"
    return (
        f"\n## {_words(name).capitalize()}\n\n{escaped(said)}\n\n"
        f"{_table(measured, _bars(name, constants(source)))}\n"
        f"{run['day']}, commit `{run['commit']}`; {run['machine']}, load {run['load']}. {met}\n"
    )


def _table(measured: dict[str, Any], bars: dict[str, str]) -> str:
    """A result as a table: of two dimensions, if all its parts have figures of the same names."""
    columns = list(dict.fromkeys(key for part in measured.values() if isinstance(part, dict) for key in part))
    cells = {
        (row, column): _shown(part[column]) + (f" ({bar})" if (bar := bars.get(f"{row}, {column}")) else "")
        for row, part in measured.items()
        if isinstance(part, dict)
        for column in columns
        if column in part
    }
    if all(isinstance(part, dict) for part in measured.values()) and 2 * len(cells) > len(measured) * len(columns):
        if len(columns) > len(measured):
            cells = {(row, column): text for (column, row), text in cells.items()}
            return _grid(columns, list(measured), cells)
        return _grid(list(measured), columns, cells)
    figures = dict(_flat(measured))
    cells = {(figure, "measured"): _shown(value) for figure, value in figures.items()}
    cells |= {(figure, "bar"): bar for figure, bar in bars.items()}
    return _grid(list(figures), ["measured", "bar"] if bars else ["measured"], cells)


def _grid(rows: list[str], columns: list[str], cells: dict[tuple[str, str], str]) -> str:
    head = f"| | {' | '.join(map(_words, columns))} |\n|---|{'---|' * len(columns)}\n"
    return head + "".join(
        f"| {_words(row)} | {' | '.join(cells.get((row, column), '') for column in columns)} |\n" for row in rows
    )


def _flat(measured: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """The figures of a result, each with its path."""
    for key, value in measured.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}, ")
        else:
            yield f"{before}{key}", value


def _words(name: str) -> str:
    return escaped(name.replace("_", " "))


def constants(source: ast.Module) -> dict[str, Any]:
    """The numbers and tables of numbers that a module names."""
    found = {}
    for node in source.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            try:
                found[node.target.id] = ast.literal_eval(node.value)
            except ValueError:
                continue
    return found


def _bars(name: str, known: dict[str, Any]) -> dict[str, str]:
    bars = {}
    for figure, text in BARS.get(name, {}).items():
        sense, constant = text.split(": ")
        table, _, key = constant.partition("[")
        bars[figure] = f"{sense} {known[table][key.removesuffix(']')] if key else known[table]:g}"
    if name == "store":
        for figure, (sense, number) in known["LIMITS"].items():
            bars[figure.replace(" ", ", ", 1)] = f"{'at least' if sense == '>=' else 'at most'} {number:g}"
    if name == "gas":
        from tests.support.contracts.gas import GENERATIONS, ROWS

        for key, row in ROWS.items():
            for bar, column in zip(row.bars, GENERATIONS.values(), strict=True):
                bars[f"{key}, {column}"] = f"at most {bar:,}" if bar else ""
    return bars


def _shown(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return escaped(json.dumps(value, ensure_ascii=False) if isinstance(value, list) else str(value))
    return f"{value:,}"

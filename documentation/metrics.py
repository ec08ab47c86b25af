"""The page about metrics, from the calls in the source that make them."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Final, NamedTuple

from documentation.markdown import escaped
from documentation.staging import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator

KINDS: Final = {"counter": "counter", "gauge": "gauge", "by_label": "", "MetricFamily": ""}
"""Functions that make a family, each with its type, or nothing where an argument says it."""
PARTS: Final = {
    "mesh/agent": "Agents",
    "mesh/validator": "Validators",
    "mesh/market": "Providers",
    "mesh/chain": "Chain and account",
    "mesh/content": "Content",
    "mesh/network": "Network",
    "mesh": "Every server",
    "bridges/serial": "Edge agents",
    "bridges/ipfs": "Bridge to IPFS",
    "bridges/ros1": "Bridge to ROS 1",
    "bridges/ros2": "Bridge to ROS 2",
    "bridges/foxglove": "View in Foxglove",
    "bridges/web": "Page",
}
"""Who has the metrics that a folder makes; the first that fits counts."""
HEAD: Final = """\
# Metrics

A server with [`metrics_listen`](settings.md#metrics_listen) serves them at `/metrics` for Prometheus, and its health at
`/health`. The metrics of a market have the label `lighthouse`.
"""


class Metric(NamedTuple):
    """One family."""

    name: str
    kind: str
    label: str
    meaning: str


def metrics() -> str:
    """The page's text."""
    found: dict[str, dict[str, Metric]] = {part: {} for part in PARTS.values()}
    for package in ("mesh", "bridges"):
        for path in sorted((ROOT / package).rglob("*.py")):
            relative = path.relative_to(ROOT).as_posix()
            if relative == "mesh/telemetry/metrics.py":
                continue
            for one in _made(ast.parse(path.read_text(encoding="utf-8")), relative):
                part = next(said for folder, said in PARTS.items() if relative.startswith(f"{folder}/"))
                found[part][one.name] = one
    return HEAD + "".join(_table(part, list(of.values())) for part, of in found.items() if of)


def _table(part: str, of: list[Metric]) -> str:
    rows = (
        f"| `{one.name}{{{one.label}}}` | {one.kind} | {escaped(one.meaning)} |\n"
        if one.label
        else f"| `{one.name}` | {one.kind} | {escaped(one.meaning)} |\n"
        for one in of
    )
    return f"\n## {part}\n\n| metric | type | meaning |\n|---|---|---|\n" + "".join(rows)


def _made(module: ast.Module, where: str) -> Iterator[Metric]:
    for function in (node for node in ast.walk(module) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
        texts = {
            target.id: value
            for node in ast.walk(function)
            if isinstance(node, ast.Assign)
            for target, value in _bound(node)
        }
        for call in ast.walk(function):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in KINDS:
                given = [texts.get(one.id, one) if isinstance(one, ast.Name) else one for one in call.args]
                yield _metric(call.func.id, given, f"{where}:{call.lineno}")


def _bound(node: ast.Assign) -> Iterator[tuple[ast.Name, ast.expr]]:
    for target in node.targets:
        if isinstance(target, ast.Name):
            yield target, node.value
        elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            pairs = zip(target.elts, node.value.elts, strict=False)
            yield from ((one, value) for one, value in pairs if isinstance(one, ast.Name))


def _metric(maker: str, given: list[ast.expr], where: str) -> Metric:
    def text(number: int) -> str:
        argument = given[number]
        if not isinstance(argument, ast.Constant) or not isinstance(argument.value, str):
            raise ValueError(f"{where}: the name, type and meaning of a metric are texts in the function that makes it")
        return argument.value

    if kind := KINDS[maker]:
        return Metric(text(0), kind, "", text(1))
    labels = text(3) if maker == "by_label" else _labels(given[3:])
    return Metric(text(0), text(1), labels, text(2))


def _labels(samples: list[ast.expr]) -> str:
    """The labels of `MetricSample(value, {"label": …})` anywhere in the samples."""
    names = {
        key.value: None
        for sample in samples
        for node in ast.walk(sample)
        if isinstance(node, ast.Dict)
        for key in node.keys
        if isinstance(key, ast.Constant) and isinstance(key.value, str)
    }
    return ", ".join(names)

"""Figures of a role, as Prometheus names them. Pure: a role measures itself with these, and knows nothing of HTTP.

Names end in their unit (`_seconds`, `_bytes`, `_wei`, `_wn`) and, if they only grow, in `_total`. Amounts of money are
floats here, as Prometheus has no other numbers: good for a graph, not for accounts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

Kind = Literal["counter", "gauge"]
"""Counters only grow while a process runs; gauges go up and down."""


class Sample(NamedTuple):
    """One figure of a family, told from the others by its labels."""

    value: float
    labels: Mapping[str, str] = {}


class Family(NamedTuple):
    """All figures of one name, such as `aira_messages_total` by kind and verdict."""

    name: str
    kind: Kind
    meaning: str
    """One line, for whoever reads `/metrics`."""
    samples: tuple[Sample, ...]


def counter(name: str, meaning: str, value: float) -> Family:
    """A counter without labels."""
    return Family(name, "counter", meaning, (Sample(value),))


def gauge(name: str, meaning: str, value: float) -> Family:
    """A gauge without labels."""
    return Family(name, "gauge", meaning, (Sample(value),))


def by_label(name: str, kind: Kind, meaning: str, label: str, values: Mapping[str, float]) -> Family:
    """A family with one label: a figure for each of its values."""
    return Family(name, kind, meaning, tuple(Sample(value, {label: key}) for key, value in values.items()))

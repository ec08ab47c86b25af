"""Figures of a role, as Prometheus names them. Pure: a role measures itself with these, and knows nothing of HTTP.

Names end in their unit (`_seconds`, `_bytes`, `_wei`, `_wn`) and, if they only grow, in `_total`. Amounts of money are
floats here, as Prometheus has no other numbers: good for a graph, not for accounts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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


def labelled(families: Iterable[Family], **labels: str) -> tuple[Family, ...]:
    """The same figures with further labels, such as the lighthouse that all of them are of."""
    return tuple(
        family._replace(samples=tuple(Sample(sample.value, {**labels, **sample.labels}) for sample in family.samples))
        for family in families
    )


def merged(families: Iterable[Family]) -> tuple[Family, ...]:
    """Each name once, with the samples of all families of that name: several roles of one process have the same.

    Raises `ValueError` where two of one name mean different things.
    """
    found: dict[str, Family] = {}
    for family in families:
        known = found.setdefault(family.name, family._replace(samples=()))
        if (known.kind, known.meaning) != (family.kind, family.meaning):
            raise ValueError(f"two families named {family.name}")
        found[family.name] = known._replace(samples=known.samples + family.samples)
    return tuple(found.values())

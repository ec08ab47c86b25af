"""Metric families in Prometheus terms. Pure: a role builds these from its counters and knows nothing of HTTP.

Names end in their unit (`_seconds`, `_bytes`, `_wei`, `_wn`), and counters in `_total`. Amounts of money are floats
here, because Prometheus has no other numbers: precise enough for a graph, not for accounting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

MetricType = Literal["counter", "gauge"]
"""A counter only grows while a process runs; a gauge goes up and down."""


class MetricSample(NamedTuple):
    """One value of a family, identified by its labels."""

    value: float
    labels: Mapping[str, str] = {}


class MetricFamily(NamedTuple):
    """All samples with one name, such as `aira_messages_total` by kind and verdict."""

    name: str
    kind: MetricType
    meaning: str
    """One line of help, shown by `/metrics`."""
    samples: tuple[MetricSample, ...]


def counter(name: str, meaning: str, value: float) -> MetricFamily:
    """A counter without labels."""
    return MetricFamily(name, "counter", meaning, (MetricSample(value),))


def gauge(name: str, meaning: str, value: float) -> MetricFamily:
    """A gauge without labels."""
    return MetricFamily(name, "gauge", meaning, (MetricSample(value),))


def by_label(name: str, kind: MetricType, meaning: str, label: str, values: Mapping[str, float]) -> MetricFamily:
    """A family with one label and a sample for each of its values."""
    return MetricFamily(name, kind, meaning, tuple(MetricSample(value, {label: key}) for key, value in values.items()))


def labelled(families: Iterable[MetricFamily], **labels: str) -> tuple[MetricFamily, ...]:
    """The same families with more labels on every sample, such as the lighthouse. A sample's own labels win."""
    return tuple(
        family._replace(
            samples=tuple(MetricSample(sample.value, {**labels, **sample.labels}) for sample in family.samples)
        )
        for family in families
    )


def merged(families: Iterable[MetricFamily]) -> tuple[MetricFamily, ...]:
    """One family for each name, with the samples of all families of that name.

    Several roles of one process report the same families. Raises `ValueError` if two families share a name but differ
    in type or meaning.
    """
    found: dict[str, MetricFamily] = {}
    for family in families:
        known = found.setdefault(family.name, family._replace(samples=()))
        if (known.kind, known.meaning) != (family.kind, family.meaning):
            raise ValueError(f"two families named {family.name}")
        found[family.name] = known._replace(samples=known.samples + family.samples)
    return tuple(found.values())

"""Figures as `/metrics` tells them: rendered by prometheus_client, which is loaded here and nowhere else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from prometheus_client import PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry

import mesh
from mesh.telemetry.families import merged

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from prometheus_client.core import Metric

    from mesh.telemetry.families import Family

KINDS: Final = {"counter": CounterMetricFamily, "gauge": GaugeMetricFamily}


class Figures(Collector):
    """Families as prometheus_client collects them."""

    def __init__(self, families: Iterable[Family]) -> None:
        self._families = merged(families)

    def collect(self) -> Iterator[Metric]:
        """Each family once. Raises `ValueError` for a name or a label that Prometheus does not take."""
        for family in self._families:
            labels = sorted({label for sample in family.samples for label in sample.labels})
            metric = KINDS[family.kind](family.name, family.meaning, labels=labels)
            for sample in family.samples:
                metric.add_metric([sample.labels.get(label, "") for label in labels], sample.value)
            yield metric


class Process(Collector):
    """What any process tells of itself: memory, CPU, open files, its start; and the version of the mesh."""

    def __init__(self) -> None:
        self._collectors = (ProcessCollector(registry=None), PlatformCollector(registry=None))

    def collect(self) -> Iterator[Metric]:
        """The figures now."""
        for collector in self._collectors:
            yield from collector.collect()
        version = InfoMetricFamily("aira", "The version of aira-mesh")
        version.add_metric([], {"version": mesh.__version__})
        yield version


class Exposition:
    """Renders families, and the process's own figures, in the format that a scrape asks for."""

    def __init__(self) -> None:
        self._process = Process()

    def render(self, families: Iterable[Family], *, accept: str = "") -> tuple[bytes, str]:
        """The text and its content type, for the header `Accept` of a scrape."""
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self._process)
        registry.register(Figures(families))
        encoder, content_type = choose_encoder(accept)
        return encoder(registry), content_type

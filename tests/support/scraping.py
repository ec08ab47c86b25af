"""Metrics and health as a scraper gets them: over HTTP, read by prometheus_client's own parser."""

from __future__ import annotations

import asyncio
import http.client
import json
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from prometheus_client.parser import text_string_to_metric_families

if TYPE_CHECKING:
    from collections.abc import Mapping

    from prometheus_client.core import Metric

SECONDS = 30.0
FOREIGN = ("process_", "python_")
"""The prefixes of the metrics that prometheus_client adds by itself."""


class Page(NamedTuple):
    """A response."""

    status: int
    text: str
    headers: Mapping[str, str]


class Scrape:
    """A scrape: `metrics("aira_jobs", phase="ready")` is a sample's value."""

    def __init__(self, text: str) -> None:
        self.families: dict[str, Metric] = {}
        self.samples: dict[tuple[str, frozenset[tuple[str, str]]], float] = {}
        for family in text_string_to_metric_families(text):
            assert family.name not in self.families, f"{family.name} is there twice"
            self.families[family.name] = family
            for sample in family.samples:
                place = sample.name, frozenset(sample.labels.items())
                assert place not in self.samples, f"{place} is there twice"
                self.samples[place] = sample.value

    def __call__(self, name: str, **labels: str) -> float:
        """The value of the one sample of that name with these labels among its own; 0 if there is none."""
        wanted = labels.items()
        found = [value for (known, given), value in self.samples.items() if known == name and wanted <= given]
        assert len(found) <= 1, f"{len(found)} samples of {name} with {labels}"
        return found[0] if found else 0.0

    def changes(self, before: Scrape) -> dict[str, float]:
        """The changes since then, as `name{label,…}`: counters of the mesh only, without their lighthouse."""
        counters = {name for name in self.names() if name.endswith("_total")}
        found: dict[str, float] = {}
        for (name, labels), value in self.samples.items():
            difference = value - before.samples.get((name, labels), 0.0)
            if difference and name in counters:
                kinds = ",".join(text for label, text in sorted(labels) if label != "lighthouse")
                found[f"{name}{{{kinds}}}" if kinds else name] = difference
        return found

    def names(self) -> set[str]:
        """The names of the mesh's samples."""
        return {name for name, _ in self.samples if not name.startswith(FOREIGN)}

    def of_label(self, name: str, label: str) -> set[str]:
        """The values that a label of a family has."""
        return {dict(labels)[label] for known, labels in self.samples if known == name and label in dict(labels)}


def get(url: str, path: str, *, method: str = "GET", headers: Mapping[str, str] | None = None) -> Page:
    """The answer to one question."""
    parts = urlsplit(url)
    assert parts.hostname is not None
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=SECONDS)
    try:
        connection.request(method, path, headers=dict(headers or {}))
        response = connection.getresponse()
        return Page(response.status, response.read().decode(), dict(response.headers))
    finally:
        connection.close()


async def scraped(url: str) -> Scrape:
    """The metrics now, beside the event loop, which has to answer."""
    page = await asyncio.to_thread(get, url, "/metrics")
    assert page.status == 200, page.text
    return Scrape(page.text)


async def health(url: str) -> tuple[int, dict[str, str]]:
    """The status and the parts that /health answers."""
    page = await asyncio.to_thread(get, url, "/health")
    answer = json.loads(page.text)
    assert answer["ok"] == (page.status == 200)
    return page.status, answer["parts"]

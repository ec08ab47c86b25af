"""Scrape as a role has them: put together, labelled, rendered for Prometheus, and read again."""

from __future__ import annotations

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as open_metrics

from mesh.telemetry._server import render_metrics
from mesh.telemetry.metrics import (
    Health,
    MetricFamily,
    MetricSample,
    by_label,
    counter,
    gauge,
    health_metrics,
    labelled,
    merged,
)
from tests.support.scraping import Scrape


def rendered(*families: MetricFamily) -> Scrape:
    text, content_type = render_metrics(families)
    assert content_type.startswith("text/plain")
    return Scrape(text.decode())


def test_a_counter_and_a_gauge_are_rendered_with_type_and_help() -> None:
    metrics = rendered(counter("aira_jobs_done_total", "Jobs done", 3), gauge("aira_queue", "What waits", 1.5))

    assert (metrics("aira_jobs_done_total"), metrics("aira_queue")) == (3, 1.5)
    assert (metrics.families["aira_jobs_done"].type, metrics.families["aira_jobs_done"].documentation) == (
        "counter",
        "Jobs done",
    )
    assert metrics.families["aira_queue"].type == "gauge"


def test_labels_may_hold_any_text() -> None:
    strange = 'a "quoted"\nline \\ and ☃'

    metrics = rendered(by_label("aira_x", "gauge", "x", "reason", {strange: 1, "plain": 2}))

    assert (metrics("aira_x", reason=strange), metrics("aira_x", reason="plain")) == (1, 2)


def test_a_scraper_that_asks_for_openmetrics_gets_it() -> None:
    families = [counter("aira_jobs_done_total", "Jobs done", 3)]

    text, content_type = render_metrics(families, accept="application/openmetrics-text; version=1.0.0")

    assert content_type.startswith("application/openmetrics-text")
    found = {family.name: family for family in open_metrics(text.decode())}  # type: ignore[no-untyped-call]
    assert found["aira_jobs_done"].samples[0].value == 3


def test_process_metrics_have_memory_start_and_version() -> None:
    metrics = rendered()

    assert metrics("process_resident_memory_bytes") > 1e6
    assert metrics("process_start_time_seconds") > 1e9
    assert metrics.of_label("aira_info", "version")


def test_labels_are_added_to_all_samples_and_do_not_hide_their_own() -> None:
    families = (gauge("aira_a", "a", 1), by_label("aira_b", "gauge", "b", "kind", {"demand": 2}))

    first, second = labelled(families, lighthouse="north")

    assert first.samples == (MetricSample(1, {"lighthouse": "north"}),)
    assert second.samples == (MetricSample(2, {"lighthouse": "north", "kind": "demand"}),)


def test_the_same_metric_of_two_lighthouses_is_one_family() -> None:
    both = [labelled([gauge("aira_a", "a", place)], lighthouse=name)[0] for place, name in enumerate(("n", "s"))]

    metrics = rendered(*both)

    assert (metrics("aira_a", lighthouse="n"), metrics("aira_a", lighthouse="s")) == (0, 1)


def test_two_metrics_can_not_share_a_name() -> None:
    with pytest.raises(ValueError, match="two families named aira_a"):
        merged([gauge("aira_a", "a", 1), gauge("aira_a", "something else", 1)])


@pytest.mark.parametrize(
    ("parts", "ok"),
    [
        ({"channel": "alive", "executor": "alive"}, True),
        ({"channel": "alive", "executor": "off"}, True),
        ({"channel": "waits for a router", "executor": "alive"}, False),
    ],
)
def test_a_waiting_part_is_unhealthy(parts: dict[str, str], ok: bool) -> None:
    health = Health.of(parts)

    assert health.ok is ok
    assert Health.decode(health.encode()) == health
    assert sum(sample.value for sample in health_metrics(parts).samples) == (2 if ok else 1)


def test_health_removes_secrets() -> None:
    why = "waits: no node answers at https://me:hunter2@node.example/v3/0123456789abcdef0123 (401)"

    assert Health.of({"start": why}).parts == {"start": "waits: no node answers at https://node.example (401)"}

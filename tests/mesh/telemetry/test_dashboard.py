"""The dashboard and the alerts speak of figures that roles really serve, with labels that these really have."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import pytest

from bridges.ipfs._channel import BridgeHealth, bridge_families
from bridges.ipfs._content import content_families
from bridges.serial._edge import edge_families
from bridges.serial.dialect import LineCounters
from mesh.market.provider import Provider, ProviderProcess
from mesh.network import Endpoints, Network
from mesh.telemetry._server import render_metrics
from mesh.telemetry.metrics import health_metrics, labelled
from mesh.validator.validator import Validator
from schemas.status import ContentMetrics
from tests.support.ipfs_bridge.statuses import direction, status
from tests.support.scraping import Scrape

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from mesh.agent.agent import Agent
    from mesh.telemetry.metrics import MetricFamily
    from tests.support.market import Place

ROOT: Final = Path(__file__).parents[3]
DASHBOARD: Final = ROOT / "deploy" / "grafana" / "aira-mesh.json"
ALERTS: Final = ROOT / "deploy" / "prometheus" / "alerts.yml"
ADDED: Final = {"job", "instance"}
"""Labels that Prometheus itself gives to every figure."""
ROLE: Final = {"role"}
"""A label of this test only: it distinguishes metrics of several roles."""
NAME: Final = re.compile(r"\b(?:aira|process)_[a-z0-9_]+\b")
SELECTED: Final = re.compile(r"(?P<name>\b(?:aira|process)_[a-z0-9_]+)(?:\{(?P<labels>[^}]*)\})?(?P<range>\[[^]]*\])?")
GROUPED: Final = re.compile(r"\bby \((?P<labels>[^)]*)\)")
CONTENT: Final = ContentMetrics(
    fetched=0, fetched_bytes=0, lies=0, answered=0, added=0, added_bytes=0, by_blocks=0, pinned=0, failed=0
)


class Known(NamedTuple):
    """The metric family of a name."""

    type: str
    labels: set[str]


EDGE = edge_families(LineCounters(), {"done": 1}, openings=1, losses=0, is_present=True)


def bridge() -> tuple[MetricFamily, ...]:
    ways = direction(invalid={"hash": 1}, dropped={"no-room": 1}, kinds={"demand": 1})
    return (
        *bridge_families([BridgeHealth(status(to_ipfs=ways, to_mesh=ways), True, True)]),
        *content_families(CONTENT),
    )


async def role_families(place: Place) -> list[MetricFamily]:
    """Of a provider that has rejected and taken back something, of an agent, and of a validator."""
    robot: Agent = place.agent("robot")

    @robot.on_demand
    async def hear(demand: object) -> None:
        """So that the agent hears something."""

    account, chain = place.market.accounts["person"], place.chains["person"]
    validator = Validator(settings=place.settings("judge"), account=account, chain=chain)
    async with (
        Network(Endpoints(connect=(place.endpoint,))) as network,
        Provider(network.session, place.chains["provider"], place.market.deployment.lighthouse_name) as provider,
        robot,
        validator,
    ):
        provider.ledger.rejected("DeadlineReached")
        process = ProviderProcess(network, place.chains["provider"], [provider])
        # They tell nothing over HTTP here, and measure the same.
        of_provider = [*await process.measure(), health_metrics(process.health())]
        return [
            *labelled(of_provider, role="provider"),
            *labelled(await robot.telemetry.measure(), role="agent"),
            *labelled(await validator.telemetry.measure(), role="validator"),
        ]


@pytest.fixture
async def served(place: Place) -> Mapping[str, Known]:
    """All that any role serves, by name."""
    families = [*await role_families(place), *EDGE, *bridge()]
    figures = Scrape(render_metrics(families)[0].decode())
    known = {}
    for family in figures.families.values():
        name = family.name + ("_total" if family.type == "counter" else "")
        known[name] = Known(family.type, {label for sample in family.samples for label in sample.labels} - ROLE)
    return known


def expressions() -> Iterator[str]:
    """Every expression of the dashboard and of the alerts."""
    dashboard = json.loads(DASHBOARD.read_text())
    for panel in dashboard["panels"]:
        for target in panel.get("targets", ()):
            yield target["expr"]
    for variable in dashboard["templating"]["list"]:
        if variable["type"] == "query":
            yield variable["query"]["query"]
    yield from re.findall(r"^\s+expr: (.*)$", ALERTS.read_text(), flags=re.MULTILINE)


async def test_every_expression_uses_metrics_that_are_served(served: Mapping[str, Known]) -> None:
    asked = {name for expression in expressions() for name in NAME.findall(expression)}

    assert len(asked) > 40
    assert asked <= served.keys()


async def test_every_label_of_an_expression_exists_on_its_metric(served: Mapping[str, Known]) -> None:
    for expression in expressions():
        names = NAME.findall(expression)
        for found in SELECTED.finditer(expression):
            wanted = set(re.findall(r"(\w+)\s*(?:=~|!~|!=|=)", found["labels"] or ""))
            assert wanted <= served[found["name"]].labels | ADDED, expression
        for grouped in GROUPED.finditer(expression):
            labels = {label.strip() for label in grouped["labels"].split(",")}
            assert labels <= set.union(ADDED, *(served[name].labels for name in names)), expression


async def test_rates_are_of_counters_only(served: Mapping[str, Known]) -> None:
    for expression in expressions():
        if expression.startswith("label_values("):
            continue
        for found in SELECTED.finditer(expression):
            assert bool(found["range"]) == (served[found["name"]].type == "counter"), expression
        assert expression.count("(") == expression.count(")")


async def test_names_kinds_and_meanings_are_well_formed(served: Mapping[str, Known], place: Place) -> None:
    families = [
        *await role_families(place),
        *EDGE,
        *bridge(),
    ]
    for family in families:
        assert re.fullmatch(r"aira(_[a-z]+)+", family.name), family.name
        assert family.name.endswith("_total") == (family.kind == "counter"), family.name
        assert family.meaning, family.name
        assert family.meaning[0].isupper() or family.meaning.startswith("1 "), family.name
        assert not family.meaning.endswith("."), family.name
        assert "\n" not in family.meaning, family.name
        for sample in family.samples:
            assert all(re.fullmatch(r"[a-z]+", label) for label in sample.labels), family.name
            assert not any(re.search(r"0x[0-9a-fA-F]{40}", value) for value in sample.labels.values()), family.name


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(DASHBOARD.read_text())["panels"]
    return found


def test_the_dashboard_has_its_rows_and_panels_do_not_overlap() -> None:
    rows = [panel["title"] for panel in panels() if panel["type"] == "row"]
    assert rows == ["Health", "Market", "Jobs", "Money", "Network", "Devices", "Bridge", "Validators"]
    assert len({panel["id"] for panel in panels()}) == len(panels())
    taken: set[tuple[int, int]] = set()
    for panel in panels():
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24, panel["title"]
        taken |= cells


def test_every_alert_has_a_summary_and_a_description() -> None:
    rules = ALERTS.read_text().split("- alert: ")[1:]

    assert len(rules) >= 5
    for rule in rules:
        for part in ("expr: ", "severity: ", "summary: ", "description: "):
            assert rule.count(part) == 1, rule

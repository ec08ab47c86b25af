"""The figures of a bridge: made up, and asked of one that runs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from bridges.ipfs.metrics import Standing, bridge_families, content_families, parts_of
from mesh.telemetry.metrics import merged
from schemas.status import ALIVE, ContentMetrics
from tests.bridges.ipfs.pages import health, metrics
from tests.bridges.ipfs.replays import OldDaemon
from tests.bridges.ipfs.statuses import status, way
from tests.support.commands import AIRA, Serving
from tests.support.ports import free_port
from tests.support.waiting import until_found

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from mesh.telemetry.metrics import MetricFamily
    from tests.support.routers import EmbeddedRouter

SECONDS = 60.0
MARKET = "airalab.lighthouse.3.robonomics.eth"


def figures(families: Iterable[MetricFamily]) -> dict[tuple[str, frozenset[str]], float]:
    """Each figure by its name and the values of its labels."""
    return {
        (family.name, frozenset(sample.labels.values())): sample.value
        for family in merged(families)
        for sample in family.samples
    }


def test_each_direction_of_each_lighthouse_has_figures_of_its_own() -> None:
    one = status(
        lighthouse="one",
        losses=2,
        ipfs_peers=("a", "b"),
        mesh_peers=("c",),
        to_ipfs=way(received=9, kinds={"demand": 4, "offer": 1}, known=3, carried=5, bytes=700, waiting=6, left=8),
        to_mesh=way(received=1, invalid={"signature": 1}, dropped={"no-room": 7}, unheard=10, left_waiting=11),
    )
    two = status(lighthouse="two", carries=False)
    found = figures(bridge_families([Standing(one, True, True), Standing(two, True, False)]))

    def of(name: str, *labels: str) -> float:
        return found[f"aira_bridge_{name}", frozenset(labels)]

    assert of("received_total", "one", "to-ipfs") == 9
    assert of("received_total", "one", "to-mesh") == 1
    assert of("received_total", "two", "to-ipfs") == 0
    assert of("accepted_total", "one", "to-ipfs", "demand") == 4
    assert of("accepted_total", "one", "to-ipfs", "offer") == 1
    assert of("known_total", "one", "to-ipfs") == 3
    assert of("carried_total", "one", "to-ipfs") == 5
    assert of("carried_bytes_total", "one", "to-ipfs") == 700
    assert of("waiting", "one", "to-ipfs") == 6
    assert of("left_total", "one", "to-ipfs") == 8
    assert of("invalid_total", "one", "to-mesh", "signature") == 1
    assert of("dropped_total", "one", "to-mesh", "no-room") == 7
    assert of("unheard", "one", "to-mesh") == 10
    assert of("left_waiting", "one", "to-mesh") == 11
    assert (of("daemon_losses_total", "one"), of("ipfs_peers", "one"), of("mesh_peers", "one")) == (2, 2, 1)
    assert (of("daemon_up", "one"), of("daemon_up", "two")) == (1, 0)
    assert (of("carries", "one"), of("carries", "two")) == (1, 0)


def test_all_that_is_told_of_content_is_a_figure() -> None:
    names = ContentMetrics.__struct_fields__
    told = ContentMetrics(**{name: number for number, name in enumerate(names, 1)})
    assert sorted(figures(content_families(told)).values()) == list(range(1, len(names) + 1))


def test_who_listens_is_no_part_of_health_and_who_is_missing_is() -> None:
    alone = status(lighthouse="one", state="alone")
    lost = status(lighthouse="two", state="no daemon", last_error="IPFS at http://x: gone")
    assert parts_of([Standing(alone, True, True)]) == {"router": ALIVE, "daemon for one": ALIVE}
    assert parts_of([Standing(alone, True, True), Standing(lost, True, False)])["daemon for two"] == lost.last_error
    assert parts_of([Standing(status(), False, True)]) == {"router": "waits for a router", "daemon for l": ALIVE}
    assert parts_of([Standing(status(), True, False)])["daemon for l"] != ALIVE


async def test_a_bridge_shows_its_figures_and_that_its_daemon_came(router: EmbeddedRouter, tmp_path: Path) -> None:
    daemon, port = OldDaemon(), free_port()
    where = ("--connect", router.endpoint, "--data-dir", str(tmp_path), "--api", daemon.api, "--lighthouse", MARKET)
    chain = ("--web3-http-provider", "", "--web3-ws-provider", "", "--metrics-listen", f"127.0.0.1:{port}")
    async with Serving(*AIRA, "bridge", "ipfs", *where, *chain, says="Cannot connect"):
        code, parts = await asyncio.to_thread(health, port)
        assert (code, parts["router"]) == (503, ALIVE)
        assert daemon.api in parts[f"daemon for {MARKET}"]
        assert f'aira_bridge_daemon_up{{lighthouse="{MARKET}"}} 0.0' in await asyncio.to_thread(metrics, port)
        async with daemon:

            async def is_well() -> bool:
                return (await asyncio.to_thread(health, port))[0] == 200

            await until_found(is_well, what="health", seconds=SECONDS)
            said = await asyncio.to_thread(metrics, port)
    assert f'aira_bridge_daemon_up{{lighthouse="{MARKET}"}} 1.0' in said
    assert "aira_bridge_content_fetched_total 0.0" in said
    assert "aira_network_links 1.0" in said

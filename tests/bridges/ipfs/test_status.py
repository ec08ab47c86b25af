"""A bridge's status, metrics, health and log summary."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING

from bridges.ipfs._channel import (
    BridgeHealth,
    bridge_families,
    changes_between,
    counters_of,
    health_parts,
)
from bridges.ipfs._content import content_families
from mesh.base.flood import Drops
from mesh.cli.status import describe_status
from mesh.network import Channel, Endpoints, Network
from mesh.telemetry.metrics import merged
from schemas.status import ALIVE, ContentMetrics
from tests.support.commands import AIRA, Serving
from tests.support.ipfs_bridge.bridges import bridging, on_mesh, status_of_the_bridge, until_seen
from tests.support.ipfs_bridge.replays import OldDaemon
from tests.support.ipfs_bridge.statuses import direction, health, metrics, status
from tests.support.orders import demand
from tests.support.ports import free_port
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import pytest

    from mesh.telemetry.metrics import MetricFamily
    from tests.support.routers import EmbeddedRouter


SECONDS = 60.0
MARKET = "airalab.lighthouse.3.robonomics.eth"
SIGNER = "0x" + "ab" * 20


def samples(families: Iterable[MetricFamily]) -> dict[tuple[str, frozenset[str]], float]:
    """Each value by its name and the values of its labels."""
    return {
        (family.name, frozenset(sample.labels.values())): sample.value
        for family in merged(families)
        for sample in family.samples
    }


def test_each_direction_of_each_lighthouse_has_its_own_metrics() -> None:
    one = status(
        lighthouse="one",
        losses=2,
        ipfs_peers=("a", "b"),
        mesh_peers=("c",),
        to_ipfs=direction(
            received=9, kinds={"demand": 4, "offer": 1}, known=3, carried=5, bytes=700, waiting=6, left=8
        ),
        to_mesh=direction(received=1, invalid={"signature": 1}, dropped={"no-room": 7}, unheard=10, left_waiting=11),
    )
    two = status(lighthouse="two", carries=False)
    found = samples(bridge_families([BridgeHealth(one, True, True), BridgeHealth(two, True, False)]))

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


def test_every_content_count_is_a_metric() -> None:
    names = ContentMetrics.__struct_fields__
    content = ContentMetrics(**{name: number for number, name in enumerate(names, 1)})
    assert sorted(samples(content_families(content)).values()) == list(range(1, len(names) + 1))


def test_a_missing_listener_is_healthy_and_a_missing_daemon_is_not() -> None:
    alone = status(lighthouse="one", state="alone")
    lost = status(lighthouse="two", state="no daemon", last_error="IPFS at http://x: gone")
    assert health_parts([BridgeHealth(alone, True, True)]) == {"router": ALIVE, "daemon for one": ALIVE}
    assert (
        health_parts([BridgeHealth(alone, True, True), BridgeHealth(lost, True, False)])["daemon for two"]
        == lost.last_error
    )
    assert health_parts([BridgeHealth(status(), False, True)]) == {
        "router": "waits for a router",
        "daemon for l": ALIVE,
    }
    assert health_parts([BridgeHealth(status(), True, False)])["daemon for l"] != ALIVE


async def test_a_bridge_serves_its_metrics_and_health(router: EmbeddedRouter, tmp_path: Path) -> None:
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


def test_only_changed_counters_are_reported() -> None:
    before = counters_of(status(to_ipfs=direction(carried=3, waiting=2, invalid={"key": 1})))
    now = counters_of(status(to_ipfs=direction(carried=5, invalid={"key": 1, "signature": 4}), losses=1))
    assert changes_between(before, now) == "losses=+1 to_ipfs.invalid.signature=+4 to_ipfs.carried=+2 to_ipfs.waiting=0"
    assert changes_between(now, now) == ""


def test_content_counters_are_reported_too() -> None:
    content = ContentMetrics(
        fetched=1, fetched_bytes=100, lies=0, answered=0, added=0, added_bytes=0, by_blocks=0, pinned=0, failed=0
    )
    assert changes_between({}, counters_of(status(content=content))) == "content.fetched=+1 content.fetched_bytes=+100"


async def test_a_flood_is_one_log_event_and_losses_are_a_warning(
    router: EmbeddedRouter, topic: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "bridges.ipfs._channel")
    api = f"http://127.0.0.1:{free_port()}"

    def said() -> list[logging.LogRecord]:
        ours = [record for record in caplog.records if record.name == "bridges.ipfs._channel"]
        return [record for record in ours if record.__dict__["event"] != "ipfs-daemon-outage"]

    begun = time.monotonic()
    async with (
        on_mesh(router.endpoint, topic) as mesh,
        bridging(router.endpoint, api, topic, tmp_path / "journal", limit=20, report_interval=0.5) as bridge,
    ):
        await until_seen(mesh, bridge.address)
        for number in range(100):
            mesh.channel.publish(demand(cost=number))
        await until(lambda: bridge.status().to_ipfs.received == 100, seconds=60)
        await until(lambda: any("no-room" in line.__dict__["facts"]["changes"] for line in said()), seconds=60)
        status = bridge.status()
        assert (status.to_ipfs.kinds, status.to_ipfs.dropped) == ({"demand": 20}, {"no-room": 80})
        assert status.uptime > 0
    lines = said()
    assert 1 <= len(lines) <= (time.monotonic() - begun) / 0.5
    assert max(record.levelno for record in lines) == logging.WARNING
    assert {line.__dict__["event"] for line in lines} == {"bridge-reported"}
    facts = lines[0].__dict__["facts"]
    assert (facts["lighthouse"], facts["state"], facts["carries"]) == (topic, "no daemon", "False")


async def test_a_bridge_announces_its_presence_and_answers_with_its_status(
    router: EmbeddedRouter, topic: str, tmp_path: Path
) -> None:
    api, drops = f"http://127.0.0.1:{free_port()}", Drops()
    drops.count("content-queue-full", SIGNER, 7)
    async with (
        bridging(router.endpoint, api, topic, tmp_path / "journal", drops=drops) as bridge,
        Network(Endpoints(connect=(router.endpoint,))) as network,
        Channel(network.session, topic) as channel,
    ):
        channel.announce("agent", "0x" + "12" * 20)

        async def both() -> bool:
            return {key.role for key in await channel.present()} == {"agent", "bridge"}

        await until_found(both, seconds=30)
        found = next(key for key in await channel.present() if key.role == "bridge")
        assert found.agent == bridge.address

        async def shows_both() -> bool:
            return len((await status_of_the_bridge(network.session, topic)).mesh_peers) == 2

        await until_found(shows_both, seconds=30)
        status = await status_of_the_bridge(network.session, topic)
        assert status.bridge == found.agent
        assert (status.lighthouse, status.api, status.state, status.carries) == (topic, api, "no daemon", False)
        assert status.mesh_peers == (f"agent 0x{'12' * 20}", f"bridge {bridge.address}")
        assert status.to_ipfs.received == status.to_mesh.received == 0
        shown = describe_status(status)
        assert (shown["dropped"], shown["most content-queue-full"]) == ("7 (7 content-queue-full)", f"{SIGNER} 7")

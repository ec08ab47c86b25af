"""`aira bridge ipfs` as a process."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING

from bridges.ipfs._relay import legacy_json
from mesh.network import Channel, Network
from mesh.ops.identity.roster import Member
from schemas import encode
from tests.support.commands import AIRA, Serving, aira
from tests.support.ipfs_bridge.bridges import on_mesh, status_of_the_bridge, until_seen
from tests.support.ipfs_bridge.statuses import health
from tests.support.orders import PERSON, demand, offer
from tests.support.ports import free_port
from tests.support.sites import MARKET as SITE_MARKET
from tests.support.sites import Site
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.bridges.ipfs.conftest import Swarm
    from tests.support.ipfs_bridge.bridges import Mesh
    from tests.support.ipfs_bridge.legacy import LegacyClient
    from tests.support.routers import EmbeddedRouter

MARKET = "airalab.lighthouse.3.robonomics.eth"
BRIDGE = "0x" + "ab" * 20
OTHER = "other.lighthouse.3.robonomics.eth"


def command(router: EmbeddedRouter, folder: Path, *more: str) -> tuple[str, ...]:
    where = (
        "--connect",
        router.endpoint,
        "--data-dir",
        str(folder),
        "--web3-http-provider",
        "",
        "--web3-ws-provider",
        "",
    )
    return (*AIRA, "bridge", "ipfs", *where, *more)


def test_the_bridge_runs_without_a_daemon_and_stops_on_a_signal(router: EmbeddedRouter, tmp_path: Path) -> None:
    api = f"/ip4/127.0.0.1/tcp/{free_port()}"
    line = command(router, tmp_path, "--api", api, "--lighthouse", MARKET, "--lighthouse", OTHER)
    with Serving(*line, says="Cannot connect") as bridge:
        code, _ = bridge.end(signal.SIGTERM)
        said = bridge.log()
    assert f"carries {MARKET} to and from http://127.0.0.1:" in said
    assert f"carries {OTHER}" in said
    assert code == 0
    assert "Traceback" not in said


def test_the_bridge_starts_without_the_chains_node_and_logs_the_consequence(
    router: EmbeddedRouter, tmp_path: Path
) -> None:
    line = command(router, tmp_path, "--api", f"/ip4/127.0.0.1/tcp/{free_port()}", "--lighthouse", MARKET)
    node = ("--web3-http-provider", f"http://127.0.0.1:{free_port()}", "--ens-contract", f"0x{'12' * 20}")
    with Serving(*line, *node, says="are not checked until the chain's node is reachable") as bridge:
        assert f"carries {MARKET}" in bridge.log()
        code, _ = bridge.end(signal.SIGTERM)
        said = bridge.log()
    assert code == 0
    assert said.count("are not checked") == 1
    assert "Traceback" not in said


async def test_the_bridge_waits_for_a_router(router: EmbeddedRouter, tmp_path: Path) -> None:
    await asyncio.to_thread(router.stop)
    line = command(router, tmp_path, "--api", f"/ip4/127.0.0.1/tcp/{free_port()}", "--lighthouse", MARKET)
    port = free_port()
    listen = ("--metrics-listen", f"127.0.0.1:{port}")
    async with Serving(*line, "--connect-timeout", "1", *listen, says="waits for a router") as bridge:
        code, parts = await asyncio.to_thread(health, port)
        assert (code, list(parts)) == (503, ["start"])
        assert "waits" in parts["start"]
        await asyncio.to_thread(router.start)
        await until(lambda: f"carries {MARKET}" in bridge.log(), seconds=60)
        assert bridge.log().count("waits for a router") == 1


async def test_on_a_locked_site_the_bridge_has_the_address_of_its_certificate(tmp_path: Path) -> None:
    site = Site(tmp_path)
    bridge_files = site.enlist(Member(address=BRIDGE, name="bridge", roles=("bridge",)))
    human = site.enlist(Member(address=PERSON.address, name="human", roles=("person",)))
    where = ("--connect", site.endpoint, "--data-dir", tmp_path, "--api", f"/ip4/127.0.0.1/tcp/{free_port()}")
    chain = ("--web3-http-provider", "", "--web3-ws-provider", "", "--lighthouse", SITE_MARKET)
    identity = (
        "--tls-ca",
        bridge_files.ca,
        "--tls-certificate",
        bridge_files.certificate,
        "--tls-key",
        bridge_files.key,
    )
    with site.open_router("wheel"):
        line = (*AIRA, "bridge", "ipfs", *where, *chain, *identity)
        async with (
            Serving(*line, says=f"bridge {BRIDGE} carries {SITE_MARKET}"),
            Network(site.client(human)) as network,
            Channel(network.session, SITE_MARKET) as channel,
        ):

            async def is_seen() -> bool:
                return any(key.role == "bridge" and key.agent == BRIDGE for key in await channel.present())

            await until_found(is_seen, what="the bridge's token", seconds=60)


async def test_a_killed_bridge_continues_and_sends_nothing_twice(
    router: EmbeddedRouter, swarm: Swarm, bob: LegacyClient, topic: str, tmp_path: Path
) -> None:
    await bob.listen(topic)
    line = command(router, tmp_path, "--api", swarm.a.api, "--lighthouse", topic)
    async with on_mesh(router.endpoint, topic) as mesh, Serving(*line, says="subscribed") as bridge:
        await until_seen(mesh)
        mesh.channel.publish(one := demand())
        await until(lambda: bob.heard, seconds=60)
        await until_found(lambda: has_journalled_it(mesh, topic), seconds=60)
        await asyncio.to_thread(bridge.kill)
        await until_found(lambda: nobody_hears(mesh, topic), seconds=60)
        await asyncio.to_thread(bridge.start)
        await until_seen(mesh)
        await until_found(lambda: bob.peers(topic), seconds=60)
        mesh.channel.publish(one)
        mesh.channel.publish(two := demand())
        await until(lambda: len(bob.heard) >= 2, seconds=60)
        assert bob.heard == [legacy_json(one), legacy_json(two)]
        await bob.publish(topic, legacy_json(three := offer()))
        await until(lambda: encode(three) in mesh.payloads, seconds=60)


async def has_journalled_it(mesh: Mesh, topic: str) -> bool:
    """Whether the bridge has the daemon's answer that it published a message: a crash before repeats that."""
    return (await status_of_the_bridge(mesh.network.session, topic)).to_ipfs.carried == 1


async def nobody_hears(mesh: Mesh, topic: str) -> bool:
    """Whether the router has noticed that the bridge is gone."""
    return not any(key.role == "bridge" for key in await mesh.channel.present())


def test_an_invalid_api_is_an_error_with_an_example(tmp_path: Path) -> None:
    done = aira("bridge", "ipfs", "--api", "localhost", "--data-dir", tmp_path, "--web3-http-provider", "")
    assert done.returncode == 2
    assert "/ip4/127.0.0.1/tcp/5001" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_credentials_file_is_named(router: EmbeddedRouter, tmp_path: Path) -> None:
    missing = str(tmp_path / "missing")
    line = command(router, tmp_path, "--ipfs-authorization-file", missing)
    done = aira(*line[len(AIRA) :])
    assert done.returncode == 2
    assert missing in done.stderr


def test_help_names_the_command() -> None:
    assert "ipfs" in aira("bridge", "--help").stdout
    assert "--api" in aira("bridge", "ipfs", "--help").stdout

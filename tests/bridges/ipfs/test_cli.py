"""`aira bridge ipfs` as a process."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING

from bridges.ipfs.writing import legacy_json
from schemas import encode
from tests.bridges.ipfs.bridges import on_mesh, until_seen
from tests.support.commands import AIRA, Serving, aira
from tests.support.orders import demand, offer
from tests.support.ports import free_port
from tests.support.waiting import until, until_found

if TYPE_CHECKING:
    from pathlib import Path

    from tests.bridges.ipfs.bridges import Mesh
    from tests.bridges.ipfs.conftest import Swarm
    from tests.bridges.ipfs.legacy import Bare
    from tests.support.routers import EmbeddedRouter

MARKET = "airalab.lighthouse.3.robonomics.eth"
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


def test_the_bridge_runs_without_a_daemon_says_so_and_ends_by_a_signal(router: EmbeddedRouter, tmp_path: Path) -> None:
    api = f"/ip4/127.0.0.1/tcp/{free_port()}"
    line = command(router, tmp_path, "--api", api, "--lighthouse", MARKET, "--lighthouse", OTHER)
    with Serving(*line, says="Cannot connect") as bridge:
        said = bridge.log()
        assert f"carries {MARKET} to and from http://127.0.0.1:" in said
        assert f"carries {OTHER}" in said
        code, _ = bridge.end(signal.SIGTERM)
    assert code == 0
    assert "Traceback" not in bridge.log()


async def test_a_bridge_that_was_killed_goes_on_and_carries_nothing_twice(
    router: EmbeddedRouter, swarm: Swarm, bob: Bare, topic: str, tmp_path: Path
) -> None:
    await bob.listen(topic)
    line = command(router, tmp_path, "--api", swarm.a.api, "--lighthouse", topic)
    async with on_mesh(router.endpoint, topic) as mesh, Serving(*line, says="subscribed") as bridge:
        await until_seen(mesh)
        mesh.channel.publish(one := demand())
        await until(lambda: bob.heard, seconds=60)
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


async def nobody_hears(mesh: Mesh, topic: str) -> bool:
    """Whether the router has noticed that the bridge is gone."""
    return not any(key.role == "bridge" for key in await mesh.channel.present())


def test_an_api_that_is_none_is_an_error_with_an_example(tmp_path: Path) -> None:
    done = aira("bridge", "ipfs", "--api", "localhost", "--data-dir", tmp_path, "--web3-http-provider", "")
    assert done.returncode == 2
    assert "/ip4/127.0.0.1/tcp/5001" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_file_of_credentials_that_is_not_there_is_named(router: EmbeddedRouter, tmp_path: Path) -> None:
    missing = str(tmp_path / "missing")
    line = command(router, tmp_path, "--ipfs-authorization-file", missing)
    done = aira(*line[len(AIRA) :])
    assert done.returncode == 2
    assert missing in done.stderr


def test_help_names_the_command() -> None:
    assert "ipfs" in aira("bridge", "--help").stdout
    assert "--api" in aira("bridge", "ipfs", "--help").stdout

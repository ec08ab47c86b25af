"""The whole bridge, built from settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bridges.ipfs.service import IpfsBridge
from mesh.base.background import Background
from mesh.errors import ConfigurationError
from mesh.network import Endpoints, Network
from mesh.settings import Settings, load
from tests.support.ipfs_bridge.replays import OldDaemon
from tests.support.ports import free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

    from tests.support.routers import EmbeddedRouter

ADDRESS = "0x" + "12" * 20


def test_environment_variables_hold_lists_with_commas() -> None:
    settings = load(environ={"AIRA_IPFS_PUBLIC_PROVIDERS": "http://one:5001, http://two:5001"})
    assert settings.ipfs_public_providers == ("http://one:5001", "http://two:5001")


async def test_several_channels_with_credentials_from_a_file(router: EmbeddedRouter, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("Bearer right\n")
    async with OldDaemon(authorization="Bearer right") as daemon:
        settings = Settings(
            data_dir=str(tmp_path), ipfs_http_provider=daemon.api, ipfs_authorization_file=str(tmp_path / "secret")
        )
        names = ("one.lighthouse.3.robonomics.eth", "two.lighthouse.3.robonomics.eth")
        async with (
            Network(Endpoints(connect=(router.endpoint,))) as network,
            IpfsBridge(network, settings, lighthouses=names, address=ADDRESS) as bridge,
            Background() as tasks,
        ):
            tasks.start(bridge.run(), "bridge of the test")
            await until(lambda: all(channel.link.up for channel in bridge.channels), seconds=60)
            assert [channel.status().lighthouse for channel in bridge.channels] == list(names)
            assert {channel.address for channel in bridge.channels} == {ADDRESS}


@pytest.mark.parametrize("secret", [b"two\nlines", b"\xff", "Schlüssel".encode()])
async def test_invalid_credentials_are_rejected_and_not_shown(
    router: EmbeddedRouter, tmp_path: Path, secret: bytes
) -> None:
    (tmp_path / "secret").write_bytes(secret)
    settings = Settings(data_dir=str(tmp_path), ipfs_authorization_file=str(tmp_path / "secret"))
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        with pytest.raises(ConfigurationError) as refused:
            IpfsBridge(network, settings)
    assert str(tmp_path / "secret") in str(refused.value)
    assert "lines" not in str(refused.value)


async def test_wrong_credentials_appear_in_the_status(router: EmbeddedRouter, tmp_path: Path) -> None:
    async with OldDaemon(authorization="Bearer right") as daemon:
        settings = Settings(data_dir=str(tmp_path), ipfs_http_provider=daemon.api)
        async with (
            Network(Endpoints(connect=(router.endpoint,))) as network,
            IpfsBridge(network, settings) as bridge,
            Background() as tasks,
        ):
            tasks.start(bridge.run(), "bridge of the test")
            await until(lambda: "Unauthorized" in bridge.channels[0].status().last_error, seconds=60)


async def test_an_invalid_daemon_address_is_rejected_at_once(router: EmbeddedRouter, tmp_path: Path) -> None:
    settings = Settings(data_dir=str(tmp_path), ipfs_http_provider=f"localhost:{free_port()}")
    async with Network(Endpoints(connect=(router.endpoint,))) as network:
        with pytest.raises(ConfigurationError):
            IpfsBridge(network, settings)

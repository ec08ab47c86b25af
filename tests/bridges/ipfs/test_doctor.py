"""The IPFS daemon: unreachable, without PubSub, with a password, and one that passes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from bridges.ipfs.daemon import checks
from mesh.ops.doctor import CheckStatus, DoctorContext
from mesh.settings import Settings
from tests.support.doctor.examining import Found, examined, made
from tests.support.ipfs import JsIpfs
from tests.support.ipfs_bridge.replays import RecentDaemon
from tests.support.ports import free_port

if TYPE_CHECKING:
    from pathlib import Path


class Mute(JsIpfs):
    """A daemon without PubSub."""

    def configure(self, config: dict[str, Any]) -> None:
        super().configure(config)
        config["Pubsub"] = {"Enabled": False}


async def found_at(api: str, **options: Any) -> Found:
    """The results of checking the daemon at `api`."""
    return await made(
        checks(DoctorContext(settings=Settings(ipfs_http_provider=api, **options), requested_role="bridge"))
    )


async def test_a_daemon_with_pubsub_passes(js_ipfs: JsIpfs) -> None:
    found = await found_at(js_ipfs.api)

    assert found.failed == []
    assert found.one("ipfs daemon").message == f"js-ipfs 0.18.1 at {js_ipfs.api}, with the multibase API"
    assert found.one("ipfs pubsub").message.startswith("enabled; ")


@pytest.mark.full
async def test_a_daemon_without_pubsub_fails_and_one_without_peers_is_a_warning() -> None:
    with Mute() as mute:
        found = await found_at(mute.api)

    assert found.cause("ipfs pubsub").code == "pubsub-disabled"
    assert "ipfs config --json Pubsub.Enabled true" in found.cause("ipfs pubsub").hint
    assert found.one("ipfs swarm").status is CheckStatus.WARN
    assert "--ipfs-swarm-connect" in found.one("ipfs swarm").hint


async def test_a_daemon_that_denies_access_fails(tmp_path: Path) -> None:
    secret = tmp_path / "authorization"
    secret.write_text("Bearer wrong")
    async with RecentDaemon(authorization="Bearer right") as recent:
        cause = (await found_at(recent.api, ipfs_authorization_file=str(secret))).cause("ipfs daemon")
        secret.write_text("Bearer right")
        allowed = await found_at(recent.api, ipfs_authorization_file=str(secret))

    assert cause.code == "access-denied"
    assert "--ipfs-authorization-file" in cause.hint
    assert "wrong" not in cause.message + cause.hint
    assert allowed.one("ipfs daemon").ok


async def test_an_unreachable_daemon_is_named_once() -> None:
    api = f"http://127.0.0.1:{free_port()}"
    found = await found_at(api)

    assert found.cause("ipfs daemon").code == "daemon-unreachable"
    assert api in found.cause("ipfs daemon").message
    assert list(found) == ["ipfs daemon"]


async def test_a_password_in_the_daemon_s_address_is_not_shown() -> None:
    context = DoctorContext(settings=Settings(ipfs_http_provider=f"http://me:sesame@127.0.0.1:{free_port()}"))

    found = (await made(checks(context))).one("ipfs daemon")

    assert not found.ok
    assert "sesame" not in str(found)


def test_only_a_bridge_needs_a_daemon_unless_one_is_named() -> None:
    assert "bridge" not in DoctorContext(settings=Settings()).roles
    assert "bridge" in DoctorContext(settings=Settings(), requested_role="bridge").roles
    assert "bridge" in DoctorContext(settings=Settings(ipfs_http_provider="http://ipfs:5001")).roles


async def test_a_bridge_without_a_daemon_gets_a_failed_check_among_the_others() -> None:
    settings = Settings(
        connect=(f"tcp/127.0.0.1:{free_port()}",),
        web3_http_provider=f"http://127.0.0.1:{free_port()}",
        ipfs_http_provider=f"http://127.0.0.1:{free_port()}",
    )

    assert (await examined(DoctorContext(settings=settings, requested_role="bridge"))).failed == [
        "router",
        "node",
        "ipfs daemon",
    ]

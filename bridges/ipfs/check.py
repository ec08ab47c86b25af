"""The checks of the IPFS daemon for `aira doctor`: its API, our credentials, PubSub and peers."""

from __future__ import annotations

from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from bridges.ipfs.daemon import Daemon
from bridges.ipfs.service import authorization_of
from mesh.ops.doctor.checks import Check, CheckResult, passed, warning

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.ops.doctor.checks import DoctorContext
    from mesh.settings import IpfsSettings, Settings

CALL_TIMEOUT: Final = 4.0
"""Seconds until a call times out."""


def checks(context: DoctorContext) -> list[Check]:
    """The checks of the daemon (entry point `aira.doctor_checks`)."""
    settings = context.settings
    daemon = Check("ipfs daemon", partial(check_daemon, settings))
    needs = ((daemon,),)
    return [
        daemon,
        Check("ipfs pubsub", partial(check_pubsub, settings), needs=needs),
        Check("ipfs swarm", partial(check_swarm, settings), needs=needs),
    ]


async def check_daemon(settings: IpfsSettings) -> CheckResult:
    """Whether it answers and accepts our credentials. Raises `IpfsError`, `ConfigurationError`."""
    async with _connected(settings) as daemon:
        return passed(f"{daemon.version} at {daemon.api}, with the {daemon.dialect} API")


async def check_pubsub(settings: Settings) -> CheckResult:
    """Whether PubSub is enabled, and how many others subscribe to the lighthouse's topic. Raises `IpfsError`."""
    async with _connected(settings) as daemon:
        topic = settings.lighthouse_contract
        listeners = len(await daemon.listeners(topic))
        return passed(f"enabled; {listeners} other subscriber{'' if listeners == 1 else 's'} of {topic}")


async def check_swarm(settings: IpfsSettings) -> CheckResult:
    """Whether the daemon has peers."""
    async with _connected(settings) as daemon:
        count = len(await daemon.swarm_peers())
        if not count:
            return warning(
                "the daemon has no peers, so its messages reach no other node",
                code="no-peers",
                hint="name legacy nodes with --ipfs-swarm-connect /…/p2p/ID, or give the daemon internet access",
            )
        return passed(f"connected to {count} peer{'' if count == 1 else 's'}")


@asynccontextmanager
async def _connected(settings: IpfsSettings) -> AsyncIterator[Daemon]:
    authorization = authorization_of(settings)
    async with Daemon(settings.ipfs_http_provider, authorization=authorization, call_timeout=CALL_TIMEOUT) as daemon:
        await daemon.detect_version()
        yield daemon

"""What `aira doctor` asks an IPFS daemon: is it there, are we let in, what is it, does it carry PubSub?"""

from __future__ import annotations

from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from bridges.ipfs.daemon import Daemon
from bridges.ipfs.service import authorization_of
from mesh.doctor.checks import Check
from mesh.doctor.findings import Finding, doubtful, sound

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from mesh.doctor.case import Case
    from mesh.settings import Settings

PATIENCE: Final = 4.0
"""Seconds for an answer."""


def checks(case: Case) -> list[Check]:
    """The checks of a case's daemon."""
    settings = case.settings
    daemon = Check("ipfs daemon", partial(check_daemon, settings))
    needs = ((daemon,),)
    return [
        daemon,
        Check("ipfs pubsub", partial(check_pubsub, settings), needs=needs),
        Check("ipfs swarm", partial(check_swarm, settings), needs=needs),
    ]


async def check_daemon(settings: Settings) -> Finding:
    """That it answers and lets us in. Raises `DaemonUnreachable`, `AccessDenied`, `ConfigurationError`."""
    async with _greeted(settings) as daemon:
        return sound(f"{daemon.version} at {daemon.api}, speaks the {daemon.dialect} dialect")


async def check_pubsub(settings: Settings) -> Finding:
    """That PubSub is enabled, and whether others are on the lighthouse's topic. Raises `PubSubDisabled`."""
    async with _greeted(settings) as daemon:
        topic = settings.lighthouse_contract
        listeners = len(await daemon.listeners(topic))
        return sound(f"enabled; {listeners} other{'' if listeners == 1 else 's'} on {topic}")


async def check_swarm(settings: Settings) -> Finding:
    """That the daemon is connected to others."""
    async with _greeted(settings) as daemon:
        count = len(await daemon.neighbours())
        if not count:
            return doubtful(
                "the daemon is connected to no other: what is published there nobody hears",
                do="name the legacy nodes with --ipfs-swarm-connect /…/p2p/ID, or let the daemon reach the internet",
            )
        return sound(f"connected to {count} other{'' if count == 1 else 's'}")


@asynccontextmanager
async def _greeted(settings: Settings) -> AsyncIterator[Daemon]:
    authorization = authorization_of(settings)
    async with Daemon(settings.ipfs_http_provider, authorization=authorization, patience=PATIENCE) as daemon:
        await daemon.greet()
        yield daemon

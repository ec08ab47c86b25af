"""`aira bridge ipfs`: the door to the legacy network."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.errors import ConfigurationError, NetworkUnavailable
from mesh.running import run_until_stopped
from mesh.settings import ChainSettings, NetworkSettings, TelemetrySettings, options_of
from mesh.telemetry.context import LogSource
from mesh.telemetry.logs import LogService, set_process_source
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.ipfs.service import IpfsBridge
    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings

log = logging.getLogger(__name__)

AGAIN: Final = 1.0
"""Seconds between two attempts to reach a router, each of which lasts as long as the settings say."""


@click.command("ipfs", short_help="the legacy network's IPFS PubSub channel, and its content")
@click.option("--api", help="the daemon's RPC, a multiaddr or a URL; the same as --ipfs-http-provider")
@click.option("--lighthouse", "lighthouses", multiple=True, metavar="NAME", help="several channels: name each")
@with_settings(
    *options_of(NetworkSettings),
    "ipfs_http_provider",
    "ipfs_authorization_file",
    "ipfs_gateway",
    "ipfs_public_providers",
    "ipfs_swarm_connect",
    "lighthouse_contract",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    "keyfile",
    *options_of(ChainSettings),
    *options_of(TelemetrySettings),
)
def command(settings: Settings, api: str | None, lighthouses: tuple[str, ...]) -> None:
    """Carry messages and content between the mesh and the legacy network on IPFS. Ctrl-C ends it.

    The daemon needs PubSub; it, the router and the node of the chain may come later, and come back. Several bridges may
    serve one lighthouse, each with a --data-dir of its own: one carries, the others stand by. Until the node is there,
    or without one (--web3-http-provider ""), no ENS name in a message is looked up, and deadlines are not checked.
    """
    if api:
        settings = dataclasses.replace(settings, ipfs_http_provider=api)
    run_until_stopped(lambda: _serve(settings, lighthouses), settings=settings, role="bridge")


def _address(settings: Settings) -> str | None:
    """As whom the bridge shows itself: the holder of its certificate, or of the keyfile, or nobody in particular."""
    from mesh.cli.chain_client import own_address

    if not settings.tls_certificate:
        return own_address(settings)
    from mesh.identity.certificates import facts_of, read_certificate

    path = Path(settings.tls_certificate).expanduser()
    return facts_of(read_certificate(path), path).holder.address


async def _serve(settings: Settings, lighthouses: tuple[str, ...]) -> None:
    from bridges.ipfs.addresses import base_url

    try:
        from bridges.ipfs.service import IpfsBridge
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"the IPFS bridge needs {error.name}, which is not installed", hint="pip install 'aira-mesh[ipfs]'"
        ) from error

    from mesh.starting import wait_for_files
    from mesh.telemetry.serving import Telemetry

    base_url(settings.ipfs_http_provider)  # before anything is waited for
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        await wait_for_files(settings)
        chain = _chain(settings)
        network = await _network(settings, stack, waits=telemetry.starting)
        bridge = await stack.enter_async_context(
            IpfsBridge(network, settings, lighthouses=lighthouses, chain=chain, address=_address(settings))
        )
        stack.enter_context(telemetry.showing(measure=bridge.measure, health=bridge.parts))
        await _introduce(bridge, network, stack)
        await bridge.run()


async def _introduce(bridge: IpfsBridge, network: Network, stack: AsyncExitStack) -> None:
    """Say what the bridge is, and answer who asks for its log."""
    from mesh.network import Services

    set_process_source(LogSource("bridge", parse_address(bridge.channels[0].address)))
    for channel in bridge.channels:
        words = f"bridge {channel.address} carries {channel.lighthouse} to and from {bridge.daemon.api}"
        announce(log, "bridge-started", words, bridge=channel.address)
    # Of one process: each address answers for all of it.
    for address in {channel.address for channel in bridge.channels}:
        services = await stack.enter_async_context(Services(network.session, address))
        services.offer("logs", LogService("bridge", "").logs)


async def _network(settings: Settings, stack: AsyncExitStack, *, waits: Callable[[str], None]) -> Network:
    """The session, as soon as there is a router; `waits` is told why there is none."""
    from mesh.composition import endpoints_of
    from mesh.network import Network

    said = False
    while True:
        try:
            return await stack.enter_async_context(Network(endpoints_of(settings)))
        except NetworkUnavailable as error:
            if not said:
                log.warning("the bridge waits for a router: %s", error)
            waits(str(error))
            said = True
            await asyncio.sleep(AGAIN)


def _chain(settings: Settings) -> Callable[[], Chain] | None:
    """What makes a client of the chain, if the settings name one. Raises `ConfigurationError`."""
    from mesh.composition import chain_of

    if not settings.web3_http_provider.strip() and not settings.web3_ws_provider.strip():
        return None
    chain_of(settings, None)  # that the settings can't be meant is told at once
    return lambda: chain_of(settings, None)

"""`aira bridge ipfs`: the bridge to the legacy network."""

from __future__ import annotations

import dataclasses
import logging
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import click

from bridges.ipfs.daemon import base_url
from bridges.ipfs.service import IpfsBridge
from mesh.base.log_context import LogSource
from mesh.base.outage_log import OutageLog
from mesh.cli.chain_client import own_address
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.content import Exchange
from mesh.errors import InputError
from mesh.network import Endpoints, Services
from mesh.role.composition import chain_of, open_network, open_store
from mesh.role.running import run_until_stopped, wait_for_files
from mesh.settings import ChainSettings, IpfsSettings, NetworkSettings, TelemetrySettings
from mesh.telemetry.logs import LogService, set_process_source
from mesh.telemetry.serving import Telemetry
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.chain import Chain
    from mesh.network import Network
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("ipfs", short_help="relay messages and content of the legacy network on IPFS")
@click.option("--api", help="RPC of the IPFS daemon (a multiaddr or a URL); same as --ipfs-http-provider")
@click.option(
    "--lighthouse",
    "lighthouses",
    multiple=True,
    metavar="NAME",
    help="lighthouse whose channel to bridge (may be repeated) [the settings' lighthouse_contract]",
)
@click.option(
    "--serve-api",
    metavar="HOST:PORT",
    help="where there is no daemon: serve what legacy pages use of one's RPC from the mesh, as at 127.0.0.1:5001",
)
@with_settings(
    NetworkSettings,
    IpfsSettings,
    "lighthouse_contract",
    "blocked_signers",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    "keyfile",
    ChainSettings,
    TelemetrySettings,
)
def command(settings: Settings, api: str | None, lighthouses: tuple[str, ...], serve_api: str | None) -> None:
    """Relay messages and content between the mesh and the legacy network on IPFS. Ctrl-C stops it.

    The daemon must have PubSub enabled. The bridge waits for the daemon, the router and the node, and reconnects to
    them. Several bridges may serve one lighthouse, each with its own --data-dir: one is active, the others are on
    standby. Without a node (--web3-http-provider ""), or until it is reachable, ENS names in messages are not resolved
    and deadlines are not checked. With --serve-api there is no daemon, and nothing is relayed to IPFS.
    """
    if serve_api is not None:
        run_until_stopped(lambda: _serve_api(settings, serve_api), settings=settings, role="bridge")
        return
    if api:
        settings = dataclasses.replace(settings, ipfs_http_provider=api)
    run_until_stopped(lambda: _serve(settings, lighthouses), settings=settings, role="bridge")


def _address(settings: Settings) -> str | None:
    """The bridge's address: its certificate's holder, or the keyfile's account, or None for a random one."""
    if not settings.tls_certificate:
        return own_address(settings)
    from mesh.ops.identity.certificates import holder_address

    return holder_address(settings.tls_certificate)


async def _serve(settings: Settings, lighthouses: tuple[str, ...]) -> None:
    base_url(settings.ipfs_http_provider)  # fail now rather than after waiting for files or a router
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        await wait_for_files(settings)
        chain = _chain(settings)
        network = await open_network(
            stack, Endpoints.from_settings(settings), OutageLog(log, "router"), on_wait=telemetry.starting
        )
        bridge = await stack.enter_async_context(
            IpfsBridge(network, settings, lighthouses=lighthouses, chain=chain, address=_address(settings))
        )
        stack.enter_context(telemetry.showing(measure=bridge.measure, health=bridge.parts))
        await _introduce(bridge, network, stack)
        await bridge.run()


async def _serve_api(settings: Settings, address: str) -> None:
    """Serve the daemon's RPC from the mesh; no daemon is needed."""
    from bridges.ipfs._serving import IpfsApi

    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"{address!r} is not as in 127.0.0.1:5001")
    async with AsyncExitStack() as stack:
        network = await open_network(
            stack, Endpoints.from_settings(settings), OutageLog(log, "router"), on_wait=lambda _: None
        )
        directory = settings.state_directory / "bridge" / "ipfs-api"
        store = await open_store(stack, settings, directory, limit=settings.objective_size_limit)
        exchange = await stack.enter_async_context(Exchange(network.session, store))
        limit, timeout = settings.objective_size_limit, settings.fetch_timeout
        api = await stack.enter_async_context(
            IpfsApi(
                network.session, store, exchange,
                host=host, port=int(port), size_limit=limit, timeout=timeout,
            )
        )  # fmt: skip
        announce(log, "ipfs-api-served", f"the API of IPFS is served from the mesh at {api.url}", url=api.url)
        await api.run()


async def _introduce(bridge: IpfsBridge, network: Network, stack: AsyncExitStack) -> None:
    """Announce the bridge, and serve its log."""
    set_process_source(LogSource("bridge", parse_address(bridge.channels[0].address)))
    for channel in bridge.channels:
        words = f"bridge {channel.address} carries {channel.lighthouse} to and from {bridge.daemon.api}"
        announce(log, "bridge-started", words, bridge=channel.address)
    # The process has one log, which it serves at each address.
    for address in {channel.address for channel in bridge.channels}:
        services = await stack.enter_async_context(Services(network.session, address))
        services.offer("logs", LogService("bridge", "").logs)


def _chain(settings: ChainSettings) -> Callable[[], Chain] | None:
    """A factory of chain clients, None if the settings name no node. Raises `ConfigurationError`."""
    if not settings.web3_http_provider.strip() and not settings.web3_ws_provider.strip():
        return None
    chain_of(settings, None)  # checks the settings now
    return lambda: chain_of(settings, None)

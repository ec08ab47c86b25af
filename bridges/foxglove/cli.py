"""`aira foxglove`: shows the market, an agent or a job in Foxglove."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from bridges.web.cli import token_in
from mesh.agent.status import WatcherStatus
from mesh.background import Background
from mesh.cli.options import ADDRESS, FILE, with_settings
from mesh.cli.output import announce
from mesh.extras import needs_extra
from mesh.running import run_until_stopped
from mesh.settings import ChainSettings, NetworkSettings, TelemetrySettings, options_of
from mesh.starting import open_when_ready
from mesh.telemetry.serving import Telemetry
from schemas import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.foxglove.front import FoxgloveFront
    from bridges.foxglove.options import FoxgloveOptions
    from mesh.network import Channel, Network
    from mesh.settings import Settings

log = logging.getLogger(__name__)

LAYOUTS: Final = ("agent", "job", "market")


@click.group("foxglove", short_help="show the market, an agent or a job in Foxglove")
def command() -> None:
    """Serve a live view for Foxglove: open a connection there to the address that is printed. Ctrl-C stops it.

    It listens on this machine only; other addresses need --certificate, --key and --token-file. Clients only look on:
    nothing that they send reaches the mesh.
    """


def served(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of the server."""
    for option in (
        click.option("--origin", "origins", multiple=True, metavar="ORIGIN", help="other site that may connect"),
        click.option("--token-file", type=FILE, help="file with the token that clients add to the address"),
        click.option("--key", type=FILE, help="key of the certificate (PEM)"),
        click.option("--certificate", type=FILE, help="certificate of this server for TLS (PEM)"),
        click.option("--listen", default="127.0.0.1:8765", show_default=True, metavar="HOST:PORT", help="address"),
    ):
        function = option(function)
    return function


_WATCHING: Final = (*options_of(NetworkSettings), "lighthouse_contract", *options_of(TelemetrySettings))


@command.command("market", short_help="orders, results, jobs and readings of a market")
@served
@with_settings(*_WATCHING)
def market(settings: Settings, **options: Any) -> None:
    """Show everything that happens on a lighthouse's market. Needs a router, but no account and no chain."""
    run_until_stopped(lambda: _serve(settings, options, _market), settings=settings, role="foxglove")


@command.command("agent", short_help="an agent's readings, devices, jobs, status and log")
@click.argument("address", type=ADDRESS)
@served
@with_settings(*_WATCHING)
def agent(settings: Settings, address: str, **options: Any) -> None:
    """Show what the agent with ADDRESS and its devices publish. Needs a router, but no account and no chain."""
    work = partial(_agent, parse_address(address))
    run_until_stopped(lambda: _serve(settings, options, work), settings=settings, role="foxglove")


@command.command("job", short_help="a running job; one that has ended, to scrub through")
@click.argument("liability")
@served
@with_settings(*_WATCHING, "objective_size_limit", "content_limit", "fetch_timeout", *options_of(ChainSettings))
def job(settings: Settings, liability: str, **options: Any) -> None:
    """Show the job of the contract LIABILITY while it runs. One that has ended is played from its recording, and
    Foxglove controls that: play, pause, speed, seek. A job that ends while it is watched can be played then."""
    work = partial(_job, parse_address(liability))
    run_until_stopped(lambda: _serve(settings, options, work), settings=settings, role="foxglove")


@command.command("layout", short_help="a layout to import in Foxglove")
@click.argument("name", type=click.Choice(LAYOUTS))
@click.option("--plot", "plots", multiple=True, metavar="PATH", help="plot this, as in /temperature.data")
@click.option("--image", "images", multiple=True, metavar="TOPIC", help="show the images of this topic")
@click.option("--out", type=FILE, help="file to write (new)")
def layout(name: str, plots: tuple[str, ...], images: tuple[str, ...], out: Any) -> None:
    """Print the layout NAME, or save it with --out. In Foxglove: Layouts, Import from file."""
    from bridges.foxglove.layouts import layout_json
    from mesh.cli.files import require_new_file

    text = layout_json(name, plots=plots, images=images)
    if out is None:
        click.echo(text)
    else:
        require_new_file(out).write_text(text + "\n")


async def _serve(
    settings: Settings, options: dict[str, Any], show: Callable[[Settings, Telemetry, FoxgloveFront], Any]
) -> None:
    """Open the address that clients connect to, and show something there until cancelled."""
    with needs_extra("foxglove", "aira foxglove"):
        from bridges.foxglove.front import FoxgloveFront
        from bridges.foxglove.server import FoxgloveServer  # noqa: F401 - whether the SDK is here
    from mesh.flood import Drops

    chosen = await asyncio.to_thread(foxglove_options, options)
    drops = Drops()
    async with (
        Telemetry(settings.metrics_listen) as telemetry,
        FoxgloveFront(chosen, drops) as front,
        Background() as tasks,
    ):
        tasks.start(drops.run(), "foxglove: drops")
        await show(settings, telemetry, front)


def foxglove_options(options: dict[str, Any]) -> FoxgloveOptions:
    """The options as the server takes them. Raises `InputError`, `InvalidListenAddress`, `NotOpenToOthers`."""
    from bridges.foxglove.options import FoxgloveOptions
    from mesh.telemetry.health import listen_address

    host, port = listen_address(options["listen"])
    chosen = FoxgloveOptions(
        host=host,
        port=port,
        token=token_in(options["token_file"]),
        certificate=str(options["certificate"] or ""),
        key=str(options["key"] or ""),
        origins=options["origins"],
    )
    chosen.check()
    return chosen


async def _market(settings: Settings, telemetry: Telemetry, front: FoxgloveFront) -> None:
    from bridges.foxglove.server import FoxgloveServer
    from bridges.foxglove.sources import show_market

    async with AsyncExitStack() as stack:
        network, channel = await _watching(stack, settings, telemetry, front)
        name = f"market {channel.lighthouse}"
        server = await stack.enter_async_context(FoxgloveServer(front, name, front.drops))
        _announce(front, name, network)
        await show_market(server, network.session, channel)


async def _agent(address: str, settings: Settings, telemetry: Telemetry, front: FoxgloveFront) -> None:
    from bridges.foxglove.server import FoxgloveServer
    from bridges.foxglove.sources import show_agent

    async with AsyncExitStack() as stack:
        network, channel = await _watching(stack, settings, telemetry, front)
        name = f"agent {address}"
        server = await stack.enter_async_context(FoxgloveServer(front, name, front.drops))
        _announce(front, name, network)
        await show_agent(server, network.session, address, channel.lighthouse, drops=front.drops)


async def _job(address: str, settings: Settings, telemetry: Telemetry, front: FoxgloveFront) -> None:
    with needs_extra("chain", "aira foxglove job"):
        from bridges.foxglove.jobs import show_job_until_end, show_recording
        from bridges.web.components import opened

    own = replace(settings, keyfile="")
    async with AsyncExitStack() as stack:
        make = partial(opened, own)
        parts = await open_when_ready(stack, own, make, role="view", on_wait=telemetry.starting)
        _show_health(stack, telemetry, parts.network, parts.channel, front)
        _announce(front, f"job {address}", parts.network)
        liability = await show_job_until_end(parts, front, address)
        await show_recording(parts, front, liability)


async def _watching(
    stack: AsyncExitStack, settings: Settings, telemetry: Telemetry, front: FoxgloveFront
) -> tuple[Network, Channel]:
    """The router and the channel of the market."""
    from mesh.agent.components import watching

    make = partial(watching, settings, drops=front.drops)
    network, channel = await open_when_ready(stack, settings, make, role="view", on_wait=telemetry.starting)
    _show_health(stack, telemetry, network, channel, front)
    return network, channel


def _show_health(
    stack: AsyncExitStack, telemetry: Telemetry, network: Network, channel: Channel, front: FoxgloveFront
) -> None:
    status = WatcherStatus(network, channel, front.drops)
    stack.enter_context(telemetry.showing(measure=lambda: status.measure(()), health=status.health))


def _announce(front: FoxgloveFront, name: str, network: Network) -> None:
    announce(log, "foxglove-started", f"foxglove    {front.url}, {name}", url=front.url, zenoh=network.id)

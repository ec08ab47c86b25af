"""`aira foxglove`: shows the market, an agent or a job in Foxglove."""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

import click

from bridges.serving import listening, with_certificate
from bridges.web.cli import token_in
from mesh.base.background import Background
from mesh.base.extras import needs_extra
from mesh.cli.options import ADDRESS, FILE, with_settings
from mesh.cli.output import announce
from mesh.role.running import open_when_ready, run_until_stopped
from mesh.settings import ChainSettings, NetworkSettings, TelemetrySettings
from mesh.telemetry.serving import Telemetry
from schemas import parse_address
from schemas.decoding import decode_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from bridges.foxglove.server import FoxgloveFront
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
        with_certificate,
        click.option(
            "--listen", default="127.0.0.1:8765", show_default=True, metavar="HOST:PORT", help="address to listen on"
        ),
    ):
        function = option(function)
    return function


_WATCHING: Final = (NetworkSettings, "lighthouse_contract", TelemetrySettings)


@command.command("market", short_help="orders, results, jobs and readings of a market")
@served
@with_settings(*_WATCHING)
def market(settings: Settings, **options: Any) -> None:
    """Show everything that happens on a lighthouse's market. Needs a router, but no account and no chain."""
    run_until_stopped(lambda: _serve(settings, options, partial(_live, "")), settings=settings, role="foxglove")


@command.command("agent", short_help="an agent's readings, devices, jobs, status and log")
@click.argument("address", type=ADDRESS)
@served
@with_settings(*_WATCHING)
def agent(settings: Settings, address: str, **options: Any) -> None:
    """Show what the agent with ADDRESS and its devices publish. Needs a router, but no account and no chain."""
    work = partial(_live, parse_address(address))
    run_until_stopped(lambda: _serve(settings, options, work), settings=settings, role="foxglove")


@command.command("job", short_help="a running job; one that has ended, to scrub through")
@click.argument("liability")
@served
@with_settings(*_WATCHING, "objective_size_limit", "content_limit", "fetch_timeout", ChainSettings)
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
    from mesh.cli.files import require_new_file

    text = layout_json(name, plots=plots, images=images)
    if out is None:
        click.echo(text)
    else:
        require_new_file(out).write_text(text + "\n", encoding="utf-8")


def layout_json(name: str, *, plots: tuple[str, ...], images: tuple[str, ...]) -> str:
    """The layout of that name, with these paths in its plot, and a panel for each of these topics of images."""
    text = (files("bridges.foxglove") / "layouts" / f"{name}.json").read_text(encoding="utf-8")
    layout: dict[str, Any] = decode_json(text)
    panels = layout["configById"]
    if plots:
        series = [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in plots]
        panels["Plot!values"]["paths"] = series
    for number, topic in enumerate(images):
        panel = f"Image!{number}"
        panels[panel] = {"imageMode": {"imageTopic": topic}}
        layout["layout"] = {"direction": "row", "first": layout["layout"], "second": panel, "splitPercentage": 70}
    return json.dumps(layout, indent=2)


async def _serve(
    settings: Settings, options: dict[str, Any], show: Callable[[Settings, Telemetry, FoxgloveFront], Any]
) -> None:
    """Open the address that clients connect to, and show something there until cancelled."""
    with needs_extra("foxglove", "aira foxglove"):
        from bridges.foxglove.server import FoxgloveFront, FoxgloveOptions
    from mesh.base.flood import Drops

    token = await asyncio.to_thread(token_in, options["token_file"])
    chosen = FoxgloveOptions(**listening(options["listen"], options, token), origins=options["origins"])
    drops = Drops()
    async with (
        Telemetry(settings.metrics_listen) as telemetry,
        FoxgloveFront(chosen, drops) as front,
        Background() as tasks,
    ):
        tasks.start(drops.run(), "foxglove: drops")
        await show(settings, telemetry, front)


async def _live(agent: str, settings: Settings, telemetry: Telemetry, front: FoxgloveFront) -> None:
    """Show the agent with that address; without one, the market."""
    from bridges.foxglove.server import FoxgloveServer
    from bridges.foxglove.sources import show_agent, show_market
    from mesh.role.composition import watching

    async with AsyncExitStack() as stack:
        make = partial(watching, settings, drops=front.drops)
        network, channel = await open_when_ready(stack, settings, make, role="view", on_wait=telemetry.starting)
        _show_health(stack, telemetry, network, channel, front)
        name = f"agent {agent}" if agent else f"market {channel.lighthouse}"
        server = await stack.enter_async_context(FoxgloveServer(front, name))
        _announce(front, name, network)
        if agent:
            await show_agent(server, network.session, agent, channel.lighthouse)
        else:
            await show_market(server, network.session, channel)


async def _job(address: str, settings: Settings, telemetry: Telemetry, front: FoxgloveFront) -> None:
    with needs_extra("chain", "aira foxglove job"):
        from bridges.foxglove.sources import show_job_until_end, show_recording
        from bridges.web.components import opened

    own = replace(settings, keyfile="")
    async with AsyncExitStack() as stack:
        make = partial(opened, own)
        parts = await open_when_ready(stack, own, make, role="view", on_wait=telemetry.starting)
        _show_health(stack, telemetry, parts.network, parts.channel, front)
        _announce(front, f"job {address}", parts.network)
        liability = await show_job_until_end(parts, front, address)
        await show_recording(parts, front, liability)


def _show_health(
    stack: AsyncExitStack, telemetry: Telemetry, network: Network, channel: Channel, front: FoxgloveFront
) -> None:
    from mesh.role.program import WatcherStatus

    status = WatcherStatus(network, channel, front.drops)
    stack.enter_context(telemetry.showing(measure=lambda: status.measure(()), health=status.health))


def _announce(front: FoxgloveFront, name: str, network: Network) -> None:
    announce(log, "foxglove-started", f"foxglove    {front.url}, {name}", url=front.url, zenoh=network.id)

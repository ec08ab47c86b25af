"""`aira router`: a Zenoh router."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.options import with_settings
from mesh.network import Endpoints, Network
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("router")
@with_settings("listen")
def command(settings: Settings) -> None:
    """Run a Zenoh router, the place where agents, providers and people meet. Ctrl-C ends it."""
    run_until_stopped(lambda: _serve(settings))


async def _serve(settings: Settings) -> None:
    async with Network(Endpoints(listen=settings.listen, mode="router")) as network:
        click.echo(f"router {network.id} listens at {', '.join(settings.listen)}")
        await asyncio.Event().wait()

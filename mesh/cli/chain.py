"""`aira chain`: a chain for development, served to other processes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.group("chain")
def command() -> None:
    """A chain for development."""


@command.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen at")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen at; 0 takes a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block every so many seconds")
@with_settings("data_dir")
def up(settings: Settings, host: str, port: int, block_time: float | None) -> None:
    """Serve an embedded chain with the contracts on it as JSON-RPC over HTTP. It is gone when this ends (Ctrl-C).

    The keyfiles of three funded accounts (provider, robot, person) are written to the data folder.
    """

    async def serve() -> None:
        from mesh.demo.development import serve_chain

        async with serve_chain(settings, host=host, port=port, block_time=block_time) as served:
            click.echo(served.describe())
            await asyncio.Event().wait()

    run_until_stopped(serve)

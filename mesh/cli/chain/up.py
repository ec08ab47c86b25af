"""`aira chain up`: a chain for development, served to other processes."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.announcing import announce
from mesh.cli.engine import chosen, with_engine
from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.cli.printing import print_json, with_json
from mesh.running import run_until_stopped
from mesh.settings import TelemetrySettings, options_of
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen at")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen at; 0 takes a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block every so many seconds")
@with_engine
@with_json
@with_settings("data_dir", *options_of(TelemetrySettings))
def command(settings: Settings, host: str, port: int, block_time: float | None, as_json: bool, **engine: Any) -> None:
    """Serve a chain with the contracts on it, as JSON-RPC over HTTP and WebSocket.

    It is gone when this ends (Ctrl-C), unless --state keeps it.

    The keyfiles of three accounts with money (provider, robot, person) are written to the data folder. Their keys are
    known to all the world: they are for development alone.
    """

    async def serve() -> None:
        from mesh.devchain.development import serve_chain

        program = chosen(**engine)
        async with (
            Telemetry(settings.metrics_listen) as telemetry,
            serve_chain(
                settings, host=host, port=port, block_time=block_time, anvil=program, state=engine["state"]
            ) as served,
        ):
            if as_json:
                print_json(served.facts())
            else:
                announce(log, served.describe(), **served.facts())
            await _tell(served.url, telemetry)

    run_until_stopped(serve, settings=settings, role="chain")


async def _tell(url: str, telemetry: Telemetry) -> None:
    """Tell how the chain at `url` is, if anybody is to be told, until cancelled."""
    from mesh.chain import Node
    from mesh.demo.looking import Look

    if not telemetry.url:
        await asyncio.Event().wait()
    async with Node(url) as node:
        look = Look(node)
        with telemetry.showing(measure=look.measure, health=look.health):
            await look.run()

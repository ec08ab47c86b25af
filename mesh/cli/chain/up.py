"""`aira chain up`: a chain for development, served to other processes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.engine import chosen, with_engine
from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.cli.printing import print_json, say, with_json
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen at")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen at; 0 takes a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block every so many seconds")
@with_engine
@with_json
@with_settings("data_dir")
def command(settings: Settings, host: str, port: int, block_time: float | None, as_json: bool, **engine: Any) -> None:
    """Serve a chain with the contracts on it, as JSON-RPC over HTTP and WebSocket.

    It is gone when this ends (Ctrl-C), unless --state keeps it.

    The keyfiles of three accounts with money (provider, robot, person) are written to the data folder. Their keys are
    known to all the world: they are for development alone.
    """

    async def serve() -> None:
        from mesh.demo.development import serve_chain

        program = chosen(**engine)
        async with serve_chain(
            settings, host=host, port=port, block_time=block_time, anvil=program, state=engine["state"]
        ) as served:
            if as_json:
                print_json(served.facts())
            else:
                say(served.describe())
            await asyncio.Event().wait()

    run_until_stopped(serve)

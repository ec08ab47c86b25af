"""`aira chain up`: a chain for development, served to other processes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.cli.printing import print_json, say, with_json
from mesh.errors import ConfigurationError
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen at")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen at; 0 takes a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block every so many seconds")
@click.option(
    "--engine",
    type=click.Choice(["auto", "anvil", "embedded"]),
    default="auto",
    show_default=True,
    help="what runs the chain; auto takes anvil where it is found",
)
@click.option("--anvil", type=click.Path(path_type=Path), help="the program anvil [the one on the path]")
@click.option("--state", type=click.Path(dir_okay=False, path_type=Path), help="file that anvil keeps the chain in")
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

        program = _engine(**engine)
        async with serve_chain(
            settings, host=host, port=port, block_time=block_time, anvil=program, state=engine["state"]
        ) as served:
            if as_json:
                print_json(served.facts())
            else:
                say(served.describe())
            await asyncio.Event().wait()

    run_until_stopped(serve)


def _engine(*, engine: str, anvil: Path | None, state: Path | None) -> Path | None:
    """The program anvil, or None for the embedded chain. Raises `ConfigurationError`."""
    from mesh.demo.anvil import find_anvil

    program = None if engine == "embedded" else find_anvil(anvil)
    if engine == "anvil" and program is None:
        raise ConfigurationError(
            "anvil is not on the path", hint="name it with --anvil FILE, or take --engine embedded, which needs nothing"
        )
    if state is not None and program is None:
        raise ConfigurationError(
            "only anvil can keep the chain in a file, and the embedded chain was "
            + ("asked for" if engine == "embedded" else "taken, as anvil is not on the path"),
            hint="name anvil with --anvil FILE, or leave --state out",
        )
    return program

"""`aira up`: all that an agent needs around it, in one process."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import click

from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.running import run_until_stopped

if TYPE_CHECKING:
    from mesh.settings import Settings


@click.command("up")
@click.option(
    "--port", type=PORT, default=8545, show_default=True, help="port of the chain's JSON-RPC; 0 takes a free one"
)
@click.option(
    "--block-time", type=BLOCK_TIME, default=1.0, show_default=True, help="mine an empty block every so many seconds"
)
@with_settings("listen", "data_dir")
def command(settings: Settings, port: int, block_time: float) -> None:
    """Run a market to develop on: a Zenoh router, a chain with the contracts, and a provider. Ctrl-C ends it.

    The keyfiles of a robot and a person with money are written to the data folder; what to do with them is printed.
    """
    run_until_stopped(lambda: _serve(settings, port, block_time))


async def _serve(settings: Settings, port: int, block_time: float) -> None:
    from mesh.demo.development import serve_chain
    from mesh.market.provider import Provider
    from mesh.network import Endpoints, Network

    async with AsyncExitStack() as stack:
        network = await stack.enter_async_context(Network(Endpoints(listen=settings.listen, mode="router")))
        served = await stack.enter_async_context(
            serve_chain(settings, host="127.0.0.1", port=port, block_time=block_time)
        )
        chain = await stack.enter_async_context(served.market.chain(served.url, "provider"))
        provider = await stack.enter_async_context(
            Provider(network.session, chain, served.market.deployment.lighthouse_name)
        )
        click.echo(f"router      {', '.join(settings.listen)}\n{served.describe()}\nprovider    {provider.address}")
        await provider.run()

"""`aira up`: all that an agent needs around it, in one process."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.announcing import announce
from mesh.cli.engine import chosen, with_engine
from mesh.cli.options import BLOCK_TIME, PORT, with_settings
from mesh.running import run_until_stopped
from mesh.settings import Settings, TelemetrySettings, options_of
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)


@click.command("up")
@click.option(
    "--port", type=PORT, default=8545, show_default=True, help="port of the chain's JSON-RPC; 0 takes a free one"
)
@click.option(
    "--block-time", type=BLOCK_TIME, default=1.0, show_default=True, help="mine an empty block every so many seconds"
)
@with_engine
@with_settings("listen", "data_dir", *options_of(TelemetrySettings))
def command(settings: Settings, port: int, block_time: float, **engine: Any) -> None:
    """Run a market to develop on: a Zenoh router, a chain with the contracts, and a provider. Ctrl-C ends it.

    The chain is gone then, unless --state keeps it. The keyfiles of a robot and a person with money are written to the
    data folder; what to do with them is printed.
    """
    run_until_stopped(lambda: _serve(settings, port, block_time, **engine), settings=settings, role="up")


async def _serve(
    settings: Settings,
    port: int,
    block_time: float,
    *,
    engine: str = "auto",
    anvil: Path | None = None,
    state: Path | None = None,
) -> None:
    from mesh.devchain.development import serve_chain
    from mesh.identity.routers import check_loopback
    from mesh.market.process import ProviderProcess
    from mesh.market.provider import Provider
    from mesh.network import Endpoints, Network

    check_loopback(settings.listen)
    program = chosen(engine=engine, anvil=anvil, state=state)
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        network = await stack.enter_async_context(Network(Endpoints(listen=settings.listen, mode="router")))
        served = await stack.enter_async_context(
            serve_chain(settings, host="127.0.0.1", port=port, block_time=block_time, anvil=program, state=state)
        )
        chain = await stack.enter_async_context(served.market.chain(served.url, "provider"))
        # Each generation has its own name for the lighthouse, and so its own keys.
        markets = [Settings(generation=3).lighthouse_contract, Settings(generation=5).lighthouse_contract]
        providers = [await stack.enter_async_context(Provider(network.session, chain, name)) for name in markets]
        process = ProviderProcess(network, chain, providers)
        stack.enter_context(telemetry.showing(measure=process.measure, health=process.health))
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        for market, provider in zip(markets, providers, strict=True):
            tasks.create_task(provider.run(), name=f"provider of {market}")
        words = f"router      {', '.join(settings.listen)}\n{served.describe()}\nprovider    {providers[0].address}"
        announce(log, words, **served.facts(), provider=providers[0].address)

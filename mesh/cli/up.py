"""`aira up` and `aira chain up`: a market, or a chain alone, for development."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.errors import AnvilMissing
from mesh.cli.options import BLOCK_TIME, PORT, with_json, with_settings
from mesh.cli.output import announce, print_json
from mesh.running import run_until_stopped
from mesh.settings import Settings, TelemetrySettings, options_of
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable


def with_engine(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options `--engine`, `--anvil` and `--state`, the arguments of `find_engine`."""
    engine = click.option(
        "--engine",
        type=click.Choice(["auto", "anvil", "embedded"]),
        default="auto",
        show_default=True,
        help="the EVM that runs the chain; auto uses anvil if it is installed",
    )
    anvil = click.option("--anvil", type=click.Path(path_type=Path), help="the program anvil [searched on the PATH]")
    kept = click.Path(dir_okay=False, path_type=Path)
    state = click.option("--state", type=kept, help="file in which anvil stores the chain")
    return engine(anvil(state(function)))


def find_engine(*, engine: str, anvil: Path | None, state: Path | None) -> Path | None:
    """The program anvil, or None for the embedded chain. Raises `AnvilMissing`."""
    from mesh.devchain.anvil import find_anvil

    program = None if engine == "embedded" else find_anvil(anvil)
    if engine == "anvil" and program is None:
        raise AnvilMissing("anvil is not on the PATH", hint="give --anvil FILE, or use --engine embedded")
    if state is not None and program is None:
        raise AnvilMissing(
            "--state needs anvil, and "
            + ("--engine embedded was given" if engine == "embedded" else "anvil is not on the PATH"),
            hint="give --anvil FILE, or omit --state",
        )
    return program


log = logging.getLogger(__name__)


@click.command("up")
@click.option(
    "--port", type=PORT, default=8545, show_default=True, help="port of the chain's JSON-RPC; 0 selects a free one"
)
@click.option(
    "--block-time",
    type=BLOCK_TIME,
    default=1.0,
    show_default=True,
    help="seconds between blocks; empty blocks are mined, too",
)
@with_engine
@with_settings("listen", "data_dir", *options_of(TelemetrySettings))
def command(settings: Settings, port: int, block_time: float, **engine: Any) -> None:
    """Run a market for development: a Zenoh router, a chain with the contracts, and a provider. Ctrl-C stops it. The
    chain is lost then, unless --state stores it.

    Writes keyfiles of a funded robot and a funded person to the data folder, and prints how to use them.
    """
    run_until_stopped(lambda: serve_market(settings, port, block_time, **engine), settings=settings, role="up")


async def serve_market(
    settings: Settings,
    port: int,
    block_time: float,
    *,
    engine: str = "auto",
    anvil: Path | None = None,
    state: Path | None = None,
) -> None:
    from mesh.agent.components import state_folder
    from mesh.devchain.development import serve_chain
    from mesh.identity.routers import check_loopback
    from mesh.market.provider import Provider, ProviderProcess
    from mesh.network import Endpoints, Network

    check_loopback(settings.listen)
    program = find_engine(engine=engine, anvil=anvil, state=state)
    async with AsyncExitStack() as stack:
        telemetry = await stack.enter_async_context(Telemetry(settings.metrics_listen))
        network = await stack.enter_async_context(Network(Endpoints(listen=settings.listen, mode="router")))
        served = await stack.enter_async_context(
            serve_chain(settings, host="127.0.0.1", port=port, block_time=block_time, anvil=program, state=state)
        )
        chain = await stack.enter_async_context(served.market.chain(served.url, "provider"))
        # Each generation has its own name for the lighthouse, and so its own keys.
        markets = [Settings(generation=3).lighthouse_contract, Settings(generation=5).lighthouse_contract]
        folder = await state_folder(settings, chain, served.market.accounts["provider"].address)
        providers = [
            await stack.enter_async_context(
                Provider(network.session, chain, name, withdrawals=folder / f"withdrawals-{name.lower()}.sqlite")
            )
            for name in markets
        ]
        process = ProviderProcess(network, chain, providers)
        stack.enter_context(telemetry.showing(measure=process.measure, health=process.health))
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        for market, provider in zip(markets, providers, strict=True):
            tasks.create_task(provider.run(), name=f"provider of {market}")
        words = f"router      {', '.join(settings.listen)}\n{served.describe()}\nprovider    {providers[0].address}"
        announce(log, "market-started", words, **served.facts(), provider=providers[0].address)


log = logging.getLogger(__name__)


@click.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen on")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen on; 0 selects a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block at this interval, in seconds")
@with_engine
@with_json
@with_settings("data_dir", *options_of(TelemetrySettings))
def chain_up(settings: Settings, host: str, port: int, block_time: float | None, as_json: bool, **engine: Any) -> None:
    """Serve a development chain with the contracts as JSON-RPC over HTTP and WebSocket. Ctrl-C stops it. The chain is
    lost then, unless --state stores it.

    Writes keyfiles of three funded accounts (provider, robot, person) to the data folder. Their keys are public: use
    them for development only.
    """

    async def serve() -> None:
        from mesh.devchain.development import serve_chain

        program = find_engine(**engine)
        async with (
            Telemetry(settings.metrics_listen) as telemetry,
            serve_chain(
                settings, host=host, port=port, block_time=block_time, anvil=program, state=engine["state"]
            ) as served,
        ):
            if as_json:
                print_json(served.facts())
            else:
                announce(log, "chain-started", served.describe(), **served.facts())
            await _show_health(served.url, telemetry)

    run_until_stopped(serve, settings=settings, role="chain")


async def _show_health(url: str, telemetry: Telemetry) -> None:
    """Serve metrics and health of the chain at `url`, if the settings ask for it, until cancelled."""
    from mesh.chain import Node
    from mesh.devchain.monitor import ChainMonitor

    if not telemetry.url:
        await asyncio.Event().wait()
    async with Node(url) as node:
        monitor = ChainMonitor(node)
        with telemetry.showing(measure=monitor.measure, health=monitor.health):
            await monitor.run()

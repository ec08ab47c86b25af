"""`aira up` and `aira chain up`: a market, or a chain alone, for development."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from mesh.cli.errors import AnvilMissing
from mesh.cli.options import BLOCK_TIME, PORT, with_json, with_settings
from mesh.cli.output import announce, print_json
from mesh.extras import PackageMissing
from mesh.page import PAGE_PORT, free_page_port, page_server
from mesh.running import run_until_stopped
from mesh.settings import Settings, TelemetrySettings, options_of
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.devchain.development import DevelopmentChain


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
@click.option("--web/--no-web", "has_page", default=True, show_default=True, help="serve the page of the market")
@click.option("--web-port", type=PORT, help=f"port of the page [{PAGE_PORT}, or a free one if it is taken]")
@click.option("--local-account", is_flag=True, help="let the page order for the person's account, without a wallet")
@with_engine
@with_settings("listen", "data_dir", *options_of(TelemetrySettings))
def command(
    settings: Settings,
    port: int,
    block_time: float,
    has_page: bool,
    web_port: int | None,
    local_account: bool,
    **engine: Any,
) -> None:
    """Run a market for development: a Zenoh router, a chain with the contracts, a provider, and the page. Ctrl-C stops
    it. The chain is lost then, unless --state stores it.

    Writes keyfiles of a funded robot and a funded person to the data folder, and prints how to use them.
    """
    served_page = MarketPage(web_port, local_account) if has_page else None
    run_until_stopped(
        lambda: serve_market(settings, port, block_time, page=served_page, **engine), settings=settings, role="up"
    )


class MarketPage(NamedTuple):
    """The page of a development market. Without a `port` it is at the usual one, or at a free one if that is taken."""

    port: int | None
    has_account: bool

    async def open(self, stack: AsyncExitStack, settings: Settings, served: DevelopmentChain) -> str:
        """Serve it until `stack` closes; its address. Raises `PackageMissing`, `PortUnavailable`."""
        from mesh.agent import Agent

        serve, port = page_server(), free_page_port(self.port)
        deployment = served.market.deployment
        own = replace(
            settings,
            connect=settings.listen,
            data_dir=str(settings.state_directory / "page"),
            lighthouse_contract=deployment.lighthouse_name,
            ens_contract=deployment.ens,
            metrics_listen="",
            enable_executor=False,
        )
        chain = await stack.enter_async_context(served.market.chain(served.url, "person"))
        agent = None
        if self.has_account:
            account = served.market.accounts["person"]
            agent = await stack.enter_async_context(Agent(settings=own, account=account, chain=chain))
        return await stack.enter_async_context(serve(own, port=port, chain=chain, agent=agent))


async def serve_market(
    settings: Settings,
    port: int,
    block_time: float,
    *,
    page: MarketPage | None = None,
    engine: str = "auto",
    anvil: Path | None = None,
    state: Path | None = None,
) -> None:
    from mesh.composition import provider_files
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
        markets = [Settings(generation=generation).lighthouse_contract for generation in (3, 5)]
        address, providers = served.market.accounts["provider"].address, []
        for name in markets:
            files = await provider_files(settings, chain, address, name)
            provider = Provider(network.session, chain, name, **files)
            providers.append(await stack.enter_async_context(provider))
        process = ProviderProcess(network, chain, providers)
        stack.enter_context(telemetry.showing(measure=process.measure, health=process.health))
        where = await _page_line(stack, page, settings, served)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        for name, provider in zip(markets, providers, strict=True):
            tasks.create_task(provider.run(), name=f"provider of {name}")
        router = ", ".join(settings.listen)
        words = f"router      {router}\n{served.describe()}\n{where}provider    {address}"
        announce(log, "market-started", words, **served.facts(), provider=address)


async def _page_line(
    stack: AsyncExitStack, page: MarketPage | None, settings: Settings, served: DevelopmentChain
) -> str:
    """Serve the page; the line that says where it is, or what it lacks."""
    if page is None:
        return ""
    try:
        return f"page        {await page.open(stack, settings, served)}\n"
    except PackageMissing as error:
        return f"page        none: {error}; {error.hint}\n"


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

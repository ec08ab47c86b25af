"""`aira up` and `aira chain up`: a market, or a chain alone, for development; and `aira demo`: one job, end to end."""

from __future__ import annotations

import asyncio
import logging
import shlex
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from mesh.base.extras import PackageMissing, needs_extra
from mesh.cli.files import require_readable
from mesh.cli.options import BLOCK_TIME, FILE, FOLDER, PATH, PORT, with_json, with_settings
from mesh.cli.output import announce, print_json
from mesh.dev.page import PAGE_PORT, page_server
from mesh.errors import ConfigurationError
from mesh.role.running import INTERRUPTED, run_to_end, run_until_stopped
from mesh.settings import Settings, TelemetrySettings
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.dev.development import DevelopmentChain


log = logging.getLogger(__name__)


def with_engine(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options `--engine`, `--anvil` and `--state`, the arguments of `find_engine`."""
    engine = click.option(
        "--engine",
        type=click.Choice(["auto", "anvil", "embedded"]),
        default="auto",
        show_default=True,
        help="the EVM that runs the chain; auto uses anvil if it is installed",
    )
    anvil = click.option("--anvil", type=PATH, help="the program anvil [searched on the PATH]")
    state = click.option("--state", type=FILE, help="file in which anvil stores the chain")
    return engine(anvil(state(function)))


def find_engine(*, engine: str, anvil: Path | None, state: Path | None) -> Path | None:
    """The program anvil, or None for the embedded chain. Raises `ConfigurationError`."""
    from mesh.dev.anvil import find_anvil

    program = None if engine == "embedded" else find_anvil(anvil)
    if engine == "anvil" and program is None:
        raise ConfigurationError(
            "anvil is not on the PATH", hint="give --anvil FILE, or use --engine embedded", code="anvil-missing"
        )
    if state is not None and program is None:
        raise ConfigurationError(
            "--state needs anvil, and "
            + ("--engine embedded was given" if engine == "embedded" else "anvil is not on the PATH"),
            hint="give --anvil FILE, or omit --state",
            code="anvil-missing",
        )
    return program


with_page_port = click.option(
    "--web-port", type=PORT, help=f"port of the page [{PAGE_PORT}, or a free one if it is taken]"
)


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
@with_page_port
@click.option(
    "--local-account/--no-local-account",
    default=True,
    show_default="local account",
    help="let the page order for the person's account, without a wallet",
)
@click.option("--run", "program", type=PATH, help="robot (NAME.py) to run, too; it starts again when you change it")
@with_engine
@with_json
@with_settings("listen", "data_dir", "generation", "free_contracts", TelemetrySettings)
def command(
    settings: Settings,
    port: int,
    block_time: float,
    has_page: bool,
    web_port: int | None,
    local_account: bool,
    program: Path | None,
    as_json: bool,
    **engine: Any,
) -> None:
    """Run a market for development: a Zenoh router, a chain with the contracts, a provider, and the page. Ctrl-C stops
    it. The chain is lost then, unless --state stores it.

    Writes keyfiles of a funded robot and a funded person to the data folder, and prints the `export` lines with which
    another shell uses the market as the person. The markets of both generations run; --generation says which one these
    lines name.
    """
    robot = None if program is None else require_readable(program)
    served_page = MarketPage(web_port, local_account) if has_page else None
    run_until_stopped(
        lambda: serve_market(settings, port, block_time, page=served_page, robot=robot, as_json=as_json, **engine),
        settings=settings,
        role="up",
    )


class MarketPage(NamedTuple):
    """The page of a development market. Without a `port` it is at the usual one, or at a free one if that is taken."""

    port: int | None
    has_account: bool

    async def open(self, stack: AsyncExitStack, settings: Settings, served: DevelopmentChain) -> tuple[str, str]:
        """Serve it until `stack` closes: its address, or empty and why there is none. Raises `PortUnavailable`."""
        from mesh.agent.agent import Agent

        try:
            serve = page_server(self.port)
        except PackageMissing as error:
            return "", f"none: {error}; {error.hint}"
        own = replace(
            settings,
            connect=settings.listen,
            data_dir=str(settings.state_directory / "page"),
            ens_contract=served.market.deployment.ens,
            metrics_listen="",
            enable_executor=False,
        )
        chain = await stack.enter_async_context(served.market.chain(served.url, "person"))
        agent = None
        if self.has_account:
            account = served.market.accounts["person"]
            agent = await stack.enter_async_context(Agent(settings=own, account=account, chain=chain))
        return await stack.enter_async_context(serve(own, chain=chain, agent=agent)), ""


async def serve_market(
    settings: Settings,
    port: int,
    block_time: float,
    *,
    page: MarketPage | None = None,
    robot: Path | None = None,
    as_json: bool = False,
    engine: str = "auto",
    anvil: Path | None = None,
    state: Path | None = None,
) -> None:
    from mesh.dev.development import run_watched, serve_chain
    from mesh.market.provider import Provider, ProviderOptions, ProviderProcess, provider_file
    from mesh.network import Endpoints, Network
    from mesh.network.locators import with_free_ports
    from mesh.ops.identity.routers import check_loopback

    check_loopback(settings.listen)
    own = Settings(generation=settings.generation).lighthouse_contract
    settings = replace(settings, listen=with_free_ports(settings.listen), lighthouse_contract=own)
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
            options = ProviderOptions(
                free_contracts=settings.free_contracts, store=await provider_file(settings, chain, address, name)
            )
            provider = Provider(network.session, chain, name, options)
            providers.append(await stack.enter_async_context(provider))
        process = ProviderProcess(network, chain, providers)
        stack.enter_context(telemetry.showing(measure=process.measure, health=process.health))
        address_of_page, without_page = ("", "") if page is None else await page.open(stack, settings, served)
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        for name, provider in zip(markets, providers, strict=True):
            tasks.create_task(provider.run(), name=f"provider of {name}")
        variables = _variables(settings, served)
        facts = served.facts() | {
            "lighthouseName": settings.lighthouse_contract,
            "router": list(settings.listen),
            "page": address_of_page or None,
            "provider": address,
            "environment": variables,
        }
        if as_json:
            print_json(facts)
        else:
            shown = f"\npage        {address_of_page or without_page}" if page is not None else ""
            lines = "\n".join(f"export {name}={shlex.quote(value)}" for name, value in variables.items())
            described = served.describe(settings.lighthouse_contract)
            words = f"router      {', '.join(settings.listen)}\n{described}{shown}\nprovider    {address}\n\n{lines}"
            announce(log, "market-started", words, **served.facts(), provider=address)
        if robot is not None:
            robots_own = variables | {
                "AIRA_DATA_DIR": str(settings.state_directory.absolute()),
                "AIRA_KEYFILE": str((served.keys / "robot.json").absolute()),
                "AIRA_METRICS_LISTEN": "",
            }
            tasks.create_task(run_watched(robot, robots_own), name=f"running {robot.name}")


def _variables(settings: Settings, served: DevelopmentChain) -> dict[str, str]:
    """The environment in which commands use this market, for the person's account."""
    chosen = {} if settings.generation == Settings().generation else {"AIRA_GENERATION": str(settings.generation)}
    return {
        "AIRA_CONNECT": ",".join(settings.listen),
        "AIRA_WEB3_HTTP_PROVIDER": served.url,
        "AIRA_WEB3_WS_PROVIDER": served.ws_url,
        **chosen,
        "AIRA_KEYFILE": str((served.keys / "person.json").absolute()),
        "AIRA_KEYFILE_PASSWORD_FILE": str((served.keys / "password").absolute()),
    }


@click.command("up")
@click.option("--host", default="127.0.0.1", show_default=True, help="address to listen on")
@click.option("--port", type=PORT, default=8545, show_default=True, help="port to listen on; 0 selects a free one")
@click.option("--block-time", type=BLOCK_TIME, help="also mine an empty block at this interval, in seconds")
@with_engine
@with_json
@with_settings("data_dir", TelemetrySettings)
def chain_up(settings: Settings, host: str, port: int, block_time: float | None, as_json: bool, **engine: Any) -> None:
    """Serve a development chain with the contracts as JSON-RPC over HTTP and WebSocket. Ctrl-C stops it. The chain is
    lost then, unless --state stores it.

    Writes keyfiles of three funded accounts (provider, robot, person) to the data folder. Their keys are public: use
    them for development only.
    """

    async def serve() -> None:
        from mesh.dev.development import serve_chain

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
    from mesh.dev.development import ChainMonitor

    if not telemetry.url:
        await asyncio.Event().wait()
    async with Node(url) as node:
        monitor = ChainMonitor(node)
        with telemetry.showing(measure=monitor.measure, health=monitor.health):
            await monitor.run()


@click.command("demo")
@click.option("--objective", type=PATH, help="MCAP file or ROS 1 bag to play [three blinks]")
@click.option(
    "--generation", type=click.Choice(["3", "5"]), default="3", help="generation of the messages and contracts [3]"
)
@click.option("--out", type=FOLDER, help="folder in which to keep the objective and the recording")
@click.option("--web", is_flag=True, help="serve the page of the market, and leave it open on the finished job")
@with_page_port
@click.option("--json", "as_json", is_flag=True, help="print one JSON object per line; the last one is a summary")
def demo(
    objective: Path | None, generation: str, out: Path | None, web: bool, web_port: int | None, as_json: bool
) -> None:
    """Run one whole job: a person's demand and a robot's offer match, a contract holds the cost, the robot plays the
    objective to its device, records it and signs the result, and the contract pays. Everything is real and local:
    Zenoh sessions, an EVM, signatures, files.

    With --web the market stays open: the page shows the job, and orders more of the robot. Ctrl-C ends everything."""
    from tempfile import TemporaryDirectory

    with needs_extra("demo", "the demo"):
        from mesh.dev.demo import Demo, JsonNarrator, TextNarrator

    page = page_server(web_port) if web else None  # what is missing is said before anything is done
    narrator = JsonNarrator() if as_json else TextNarrator()
    with TemporaryDirectory(prefix="aira-demo-") as folder:
        job = Demo(Path(folder), objective=objective, generation=int(generation), out=out, narrator=narrator, page=page)
        run_to_end(job.run, interrupted=0 if web else INTERRUPTED)

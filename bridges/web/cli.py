"""`aira web`: serves the page."""

from __future__ import annotations

import asyncio
import logging
import tomllib
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.errors import InvalidOptions
from mesh.cli.files import require_model, require_readable
from mesh.cli.options import with_settings
from mesh.cli.output import announce
from mesh.extras import needs_extra
from mesh.running import run_until_stopped
from mesh.settings import ChainSettings, NetworkSettings, TelemetrySettings, options_of
from mesh.starting import open_when_ready, serve_on_each_chain, wait_for_files
from mesh.telemetry.serving import Telemetry
from schemas import parse_cid

if TYPE_CHECKING:
    from bridges.web.options import WebOptions
    from mesh.settings import Settings

log = logging.getLogger(__name__)

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command("web", short_help="serve the page: order work, watch it, judge it in a browser")
@click.option("--listen", default="127.0.0.1:8585", show_default=True, metavar="HOST:PORT", help="address to listen on")
@click.option("--name", "names", multiple=True, metavar="HOST", help="another name of this server (may be repeated)")
@click.option("--certificate", type=FILE, help="certificate of this server for HTTPS (PEM)")
@click.option("--key", type=FILE, help="key of the certificate (PEM)")
@click.option("--token-file", type=FILE, help="file with the token that people log in with")
@click.option("--operator-token-file", type=FILE, help="file with the token that operators log in with")
@click.option("--embed", multiple=True, metavar="ORIGIN", help="site that may show the page in a frame")
@click.option("--explorer", default="", metavar="URL", help="block explorer to link to")
@click.option("--from-block", type=click.IntRange(min=0), default=0, help="first block whose contracts are listed")
@click.option("--robot", type=FILE, help="page for one robot: a TOML file with model, objective, cost, title, text")
@click.option("--model", help="page for one robot: its model (CID)")
@click.option("--objective", help="page for one robot: what it is ordered to do (CID)")
@click.option("--cost", help="page for one robot: the price, in the smallest unit of the token")
@with_settings(
    *options_of(NetworkSettings),
    "lighthouse_contract",
    "erc20_token",
    "keyfile",
    "keyfile_password_file",
    "roster",
    "blocked_signers",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    *options_of(ChainSettings),
    *options_of(TelemetrySettings),
)
def command(settings: Settings, **options: Any) -> None:
    """Serve a page on which people order work, watch it, and judge it. Ctrl-C stops it.

    People sign with the wallet of their browser. With --keyfile the page can also order for that account: then all who
    reach the page can spend its money. It listens on this machine only; other addresses need --certificate, --key,
    and a login: --token-file, or --roster for members of the site who show their certificate.

    --model or --robot makes a page with one button, for one robot, which other sites may show in a frame (--embed).
    """
    run_until_stopped(lambda: serve(settings, options), settings=settings, role="web")


async def serve(settings: Settings, options: dict[str, Any]) -> None:
    """Serve until cancelled, also when a development chain is started afresh."""
    async with Telemetry(settings.metrics_listen) as telemetry:
        await serve_on_each_chain(settings, partial(_serve, options, telemetry))


async def _serve(options: dict[str, Any], telemetry: Telemetry, settings: Settings) -> None:
    with needs_extra("web", "aira web"):
        from bridges.web.components import opened
        from bridges.web.server import PageServer

    await wait_for_files(settings)
    chosen = await asyncio.to_thread(web_options, settings, options)
    chosen.check()
    async with AsyncExitStack() as stack:
        make = partial(opened, settings)
        components = await open_when_ready(stack, settings, make, role="page", on_wait=telemetry.starting)
        server = await stack.enter_async_context(PageServer(components, chosen))
        stack.enter_context(telemetry.showing(measure=server.measure, health=server.health))
        account = f", orders for {components.agent.address}" if components.agent else ""
        words = f"page        {server.url}{account}"
        announce(log, "page-started", words, url=server.url, zenoh=components.network.id)
        await asyncio.Event().wait()


def web_options(settings: Settings, options: dict[str, Any]) -> WebOptions:
    """The options as the server takes them. Raises `InputError`, `InvalidListenAddress`."""
    from bridges.web.options import WebOptions
    from mesh.telemetry.health import listen_address

    host, port = listen_address(options["listen"])
    return WebOptions(
        host=host,
        port=port,
        names=options["names"],
        token=token_in(options["token_file"]),
        operator_token=token_in(options["operator_token_file"]),
        certificate=str(options["certificate"] or ""),
        key=str(options["key"] or ""),
        roster=settings.roster,
        ca=settings.tls_ca,
        embed=options["embed"],
        robot=robot_of(options),
        explorer=options["explorer"],
        from_block=options["from_block"],
    )


def robot_of(options: dict[str, Any]) -> dict[str, Any] | None:
    """The one robot of the page: from the TOML file, overridden by options. None if none is named."""
    given: dict[str, Any] = {}
    if options["robot"] is not None:
        try:
            given = tomllib.loads(require_readable(options["robot"]).read_text())
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InvalidOptions(f"{options['robot']} is no TOML file: {error}") from None
    given |= {name: options[name] for name in ("model", "objective", "cost") if options[name]}
    if not given:
        return None
    if unknown := given.keys() - {"model", "objective", "cost", "title", "text"}:
        raise InvalidOptions(f"a robot's page has no {', '.join(sorted(unknown))}")
    parse_cid(require_model(str(given.get("model", ""))))
    if given.get("objective"):
        parse_cid(str(given["objective"]))
    cost = str(given.get("cost", "")) or None
    if cost is not None and not (cost.isascii() and cost.isdigit()):
        raise InvalidOptions("the cost is a whole number in the smallest unit of the token")
    return {
        "model": given["model"],
        "objective": given.get("objective") or None,
        "cost": cost,
        "title": str(given.get("title", "")),
        "text": str(given.get("text", "")),
    }


def token_in(path: Path | None) -> str:
    """The token in a file; empty without a file."""
    if path is None:
        return ""
    token = require_readable(path).read_text().strip()
    if len(token) < 16:
        raise InvalidOptions(f"the token in {path} is too short", hint="use at least 16 characters")
    return token

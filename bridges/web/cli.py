"""`aira web`: serves the page."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bridges.serving import listening, with_certificate
from mesh.base.extras import needs_extra
from mesh.cli.files import file_or_cid, model_named, require_readable
from mesh.cli.options import FILE, AmountText, with_settings
from mesh.cli.output import announce
from mesh.errors import InputError
from mesh.role.running import open_when_ready, run_until_stopped, serve_on_each_chain, wait_for_files
from mesh.settings import AccountSettings, ChainSettings, NetworkSettings, TelemetrySettings
from mesh.telemetry.serving import Telemetry
from schemas import cid_of_file
from schemas.decoding import InvalidData, decode_toml, text_of

if TYPE_CHECKING:
    from bridges.web._access import WebOptions
    from mesh.amounts import Unit
    from mesh.settings import Settings

log = logging.getLogger(__name__)


@click.command("web", short_help="serve the page: order work, watch it, judge it in a browser")
@click.option("--listen", default="127.0.0.1:8585", show_default=True, metavar="HOST:PORT", help="address to listen on")
@click.option("--name", "names", multiple=True, metavar="HOST", help="another name of this server (may be repeated)")
@with_certificate
@click.option(
    "--proxy",
    "proxies",
    multiple=True,
    metavar="ADDRESS",
    help="address of a proxy in front: its X-Forwarded-For says who asks (may be repeated)",
)
@click.option("--token-file", type=FILE, help="file with the token that people log in with")
@click.option("--operator-token-file", type=FILE, help="file with the token that operators log in with")
@click.option("--signer", type=FILE, help="owner.sock of a signer: operators allow its programs' orders on the page")
@click.option("--embed", multiple=True, metavar="ORIGIN", help="site that may show the page in a frame")
@click.option("--explorer", default="", metavar="URL", help="block explorer to link to [the chain's]")
@click.option("--from-block", type=click.IntRange(min=0), default=0, help="first block whose contracts are listed")
@click.option("--robot", type=FILE, help="page for one robot: a TOML file with model, objective, cost, title, text")
@click.option("--model", help="page for one robot: its model, a file or a CID")
@click.option("--objective", help="page for one robot: what it is ordered to do, a file or a CID")
@click.option(
    "--cost", type=AmountText(), help="page for one robot: the price, in tokens (1.5) or their smallest unit (5wn)"
)
@with_settings(
    NetworkSettings,
    "lighthouse_contract",
    "erc20_token",
    AccountSettings,
    "roster",
    "blocked_signers",
    "objective_size_limit",
    "content_limit",
    "fetch_timeout",
    ChainSettings,
    TelemetrySettings,
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
        if chosen.robot is not None:
            unit = await components.chain.tokens.unit(settings.erc20_token)
            chosen = replace(chosen, robot=priced(chosen.robot, unit))
            for file in files_of(options):
                await asyncio.to_thread(components.store.put_file, file)
        server = await stack.enter_async_context(PageServer(components, chosen))
        stack.enter_context(telemetry.showing(measure=server.measure, health=server.health))
        account = f", orders for {components.agent.address}" if components.agent else ""
        words = f"page        {server.url}{account}"
        announce(log, "page-started", words, url=server.url, zenoh=components.network.id)
        await asyncio.Event().wait()


def web_options(settings: Settings, options: dict[str, Any]) -> WebOptions:
    """The options as the server takes them. Raises `InputError`, `ConfigurationError`."""
    from bridges.web._access import WebOptions

    return WebOptions(
        **listening(options["listen"], options, token_in(options["token_file"])),
        names=options["names"],
        operator_token=token_in(options["operator_token_file"]),
        roster=settings.roster,
        ca=settings.tls_ca,
        proxies=options["proxies"],
        embed=options["embed"],
        robot=robot_of(options),
        signer=str(options["signer"] or ""),
        explorer=options["explorer"] or settings.profile.explorer,
        from_block=options["from_block"],
    )


def robot_of(options: dict[str, Any]) -> dict[str, Any] | None:
    """The one robot of the page: from the TOML file, overridden by options; its cost as it is written. None if none is
    named."""
    given = _described(options)
    if not given:
        return None
    if unknown := given.keys() - {"model", "objective", "cost", "title", "text"}:
        raise InputError(f"a robot's page has no {', '.join(sorted(unknown))}", code="invalid-options")
    objective = _objective_in(given)
    cost = str(given.get("cost", "")) or None
    if cost is not None:
        AmountText().convert(cost, None, None)  # its value depends on the token
    return {
        "model": model_named(str(given.get("model", ""))).cid(),
        "objective": cid_of_file(objective) if isinstance(objective, Path) else objective,
        "cost": cost,
        "title": str(given.get("title", "")),
        "text": str(given.get("text", "")),
    }


def priced(robot: dict[str, Any], unit: Unit) -> dict[str, Any]:
    """The robot with its cost in the smallest unit of the token, as requests have it. Raises `InvalidAmount`."""
    return robot if robot["cost"] is None else robot | {"cost": str(unit.parse(robot["cost"]))}


def files_of(options: dict[str, Any]) -> list[Path]:
    """The files of the one robot's model and objective, where files were given: others may read them."""
    given = _described(options)
    named = (model_named(str(given["model"])).file, _objective_in(given))
    return [one for one in named if isinstance(one, Path)]


def _objective_in(given: dict[str, Any]) -> Path | str | None:
    """The objective's file or CID; None if people choose. Raises `InputError`."""
    objective = file_or_cid(str(given["objective"])) if given.get("objective") else None
    return require_readable(objective) if isinstance(objective, Path) else objective


def _described(options: dict[str, Any]) -> dict[str, Any]:
    """What the TOML file and the options say of the one robot. Raises `InputError`."""
    given: dict[str, Any] = {}
    if options["robot"] is not None:
        try:
            given = decode_toml(text_of(require_readable(options["robot"]).read_bytes()))
        except InvalidData as error:
            raise InputError(f"{options['robot']} is no TOML file: {error}", code="invalid-options") from None
    return given | {name: options[name] for name in ("model", "objective", "cost") if options[name]}


def token_in(path: Path | None) -> str:
    """The token in a file; empty without a file."""
    if path is None:
        return ""
    token = text_of(require_readable(path).read_bytes()).strip()
    if len(token) < 16:
        raise InputError(f"the token in {path} is too short", hint="use at least 16 characters", code="invalid-options")
    return token

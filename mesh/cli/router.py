"""`aira router`: a Zenoh router, open on loopback or restricted by a roster."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.base.background import Background
from mesh.base.flood import Drops
from mesh.base.log_context import log_event
from mesh.base.outage_log import OutageLog
from mesh.cli.options import FILE, with_json, with_settings
from mesh.cli.output import announce, plural, print_json, print_table, printable
from mesh.errors import AiraError, ConfigurationError
from mesh.role.running import run_until_stopped
from mesh.settings import TelemetrySettings
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Iterable
    from contextlib import AbstractContextManager

    from mesh.network import Endpoints, Network
    from mesh.ops.identity import Roster
    from mesh.settings import Settings
    from mesh.telemetry.metrics import MetricFamily

log = logging.getLogger(__name__)

SITE_SETTINGS: Final = (
    "listen",
    "link",
    "tls_ca",
    "tls_certificate",
    "tls_key",
    "roster",
    "max_sessions",
    "blocked_sessions",
    "shared_memory",
)


@click.group("router", invoke_without_command=True)
@with_settings(*SITE_SETTINGS, TelemetrySettings)
@click.pass_context
def command(context: click.Context, settings: Settings) -> None:
    """Run a Zenoh router, through which agents, providers and people exchange messages. Ctrl-C stops it.

    With a roster it admits clients that have a certificate of the site, and allows each only what its role needs.
    Without one it listens on loopback only. When the roster or the certificate changes, it restarts automatically;
    clients reconnect within a second.
    """
    context.obj = settings
    if context.invoked_subcommand is None:
        run_until_stopped(lambda: serve(settings), settings=settings, role="router")


@command.command("acl", short_help="show the rights of each member")
@click.option("--check", is_flag=True, help="print a readable table instead of Zenoh's rules")
@click.option("--roster", type=FILE, help="roster [the settings']")
@with_json
@click.pass_obj
def acl(settings: Settings, check: bool, roster: Path | None, as_json: bool) -> None:
    """Print the rights that the roster grants, as Zenoh's `access_control`; with --check as a table.

    The router denies everything else.
    """
    from mesh.ops.identity import access_control, read_roster

    if roster is None and not settings.roster:
        hint = "give --roster; `aira identity new --roster FILE` creates one"
        raise ConfigurationError("no roster is set", hint=hint, code="roster-missing")
    found = read_roster(roster or Path(settings.roster).expanduser())
    if not check:
        print_json(access_control(found))
    elif as_json:
        print_json(_access(found))
    else:
        rows = [
            (printable(one["name"]), one["address"], ", ".join(one["roles"]), right, key)
            for one in _access(found)
            for right, keys in (one["may"] or {"nothing": ["(revoked)"]}).items()
            for key in keys
        ]
        print_table(("NAME", "ADDRESS", "ROLES", "MAY", "KEYS"), rows)


@command.command("config", short_help="write an equivalent configuration for zenohd")
@click.option("--out", required=True, type=FILE, help="file to write (JSON5)")
@click.pass_obj
def config(settings: Settings, out: Path) -> None:
    """Write a configuration file with which `zenohd` behaves like `aira router` with the same options.

    Give those options before `config`. zenohd reads the file only when it starts: after a change of the roster, write
    it again and restart zenohd.
    """
    from mesh.cli.files import writing
    from mesh.ops.identity.routers import router_endpoints, zenohd_configuration

    text = zenohd_configuration(router_endpoints(settings))
    with writing(out):
        out.write_text(text, encoding="utf-8")
    click.echo(f"zenohd --config {out}")


async def serve(settings: Settings) -> None:
    from mesh.network import Network
    from mesh.network.endpoints import allow_sessions
    from mesh.network.locators import with_free_ports
    from mesh.network.session import BlockedSessions, guard, report_traffic
    from mesh.ops.identity.routers import router_endpoints
    from mesh.role.running import wait_for_files

    allow_sessions(settings.max_sessions)
    drops = Drops()
    blocked = BlockedSessions(settings.blocked_sessions) if settings.blocked_sessions else None
    async with Telemetry(settings.metrics_listen) as telemetry:
        await wait_for_files(settings)
        settings = replace(settings, listen=with_free_ports(settings.listen))
        endpoints = router_endpoints(settings)
        while True:
            certificate = _own_certificate(endpoints)
            async with Network(endpoints) as network:
                # Served first: a reader of the announcement may ask for the health at once.
                with _serve_metrics(telemetry, network, drops):
                    words = f"router {network.id} listens at {', '.join(settings.listen)}"
                    announce(log, "router-started", words, zenoh=network.id)
                    words = "no roster: every client on this machine may do everything; other machines can't connect"
                    if endpoints.access is not None:
                        members = plural(len(endpoints.access["subjects"]), "member")
                        words = f"roster: {members} admitted by certificate"
                    announce(log, "access-loaded", words)
                    async with Background() as tasks:
                        if blocked is not None:
                            tasks.start(guard(network.session, blocked, drops), "blocked sessions")
                        tasks.start(report_traffic(network.session), "traffic")
                        tasks.start(drops.run(), "drops")
                        endpoints = await _wait_for_change(settings, endpoints, certificate)
            words = "the roster or the certificate changed: restarting the router"
            log.info(words, extra=log_event("router-restarted"))


def _serve_metrics(telemetry: Telemetry, network: Network, drops: Drops) -> AbstractContextManager[None]:
    """Serve a router's metrics and health: that it listens, its links, and what it dropped."""
    from mesh.telemetry.metrics import drop_family

    async def measure() -> Iterable[MetricFamily]:
        return (*network.families(), drop_family(drops))

    return telemetry.showing(measure=measure, health=lambda: {"router": network.state})


async def _wait_for_change(settings: Settings, endpoints: Endpoints, certificate: bytes) -> Endpoints:
    """Wait until the roster or the certificate changes; the new endpoints. Invalid changes are logged and ignored."""
    from mesh.ops.identity.routers import router_endpoints

    outages = OutageLog(log, "roster")
    while True:
        await asyncio.sleep(1)
        try:
            found = await asyncio.to_thread(router_endpoints, settings)
            await asyncio.to_thread(found.config)
        except AiraError as error:
            outages.failed(error, "the router keeps its previous roster")
            continue
        outages.recovered("the roster is valid again")
        if found != endpoints or _own_certificate(found) != certificate:
            return found


def _own_certificate(endpoints: Endpoints) -> bytes:
    """The router's own certificate, which Zenoh reads only when it starts to listen."""
    pair = endpoints.tls.pair if endpoints.tls is not None else None
    try:
        return pair[0].read_bytes() if pair is not None else b""
    except OSError:
        return b""


def _access(roster: Roster) -> list[dict[str, Any]]:
    """The rights of each member; revoked members have none."""
    from mesh.ops.identity import access_of

    found: dict[str, dict[str, list[str]]] = {member.address: {} for member in roster.member}
    for member, right, keys in access_of(roster):
        found[member.address][right.value] = list(keys)
    named = ("name", "address", "roles", "revoked")
    return [{name: getattr(one, name) for name in named} | {"may": found[one.address]} for one in roster.member]

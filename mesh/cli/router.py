"""`aira router`: a Zenoh router, open on loopback or restricted by a roster."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from mesh.background import Background
from mesh.cli.errors import FileUnwritable, RosterMissing
from mesh.cli.options import with_json, with_settings
from mesh.cli.output import announce, plural, print_json, print_table, printable
from mesh.errors import AiraError
from mesh.flood import Drops
from mesh.log_context import log_event
from mesh.outage_log import OutageLog
from mesh.running import fail, run_until_stopped
from mesh.settings import TelemetrySettings, options_of
from mesh.telemetry.serving import Telemetry

if TYPE_CHECKING:
    from collections.abc import Iterable
    from contextlib import AbstractContextManager

    from mesh.identity import Roster
    from mesh.network import Endpoints, Network
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
ROSTER_INTERVAL: Final = 1.0
"""Seconds between two checks of the roster."""


@click.group("router", invoke_without_command=True)
@with_settings(*SITE_SETTINGS, *options_of(TelemetrySettings))
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
@click.option("--roster", type=click.Path(dir_okay=False, path_type=Path), help="roster [the settings']")
@with_json
@click.pass_obj
def acl(settings: Settings, check: bool, roster: Path | None, as_json: bool) -> None:
    """Print the rights that the roster grants, as Zenoh's `access_control`; with --check as a table.

    The router denies everything else.
    """
    from mesh.identity import access_control

    try:
        found = _roster(settings, roster)
    except AiraError as error:
        fail(error)
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
@click.option("--out", required=True, type=click.Path(dir_okay=False, path_type=Path), help="file to write (JSON5)")
@click.pass_obj
def config(settings: Settings, out: Path) -> None:
    """Write a configuration file with which `zenohd` behaves like `aira router` with the same options.

    Give those options before `config`. zenohd reads the file only when it starts: after a change of the roster, write
    it again and restart zenohd.
    """
    from mesh.identity.routers import router_endpoints, zenohd_configuration

    try:
        text = zenohd_configuration(router_endpoints(settings))
        try:
            out.write_text(text, encoding="utf-8")
        except OSError as error:
            raise FileUnwritable(f"can't write {out}: {error.strerror}") from None
    except AiraError as error:
        fail(error)
    click.echo(f"zenohd --config {out}")


async def serve(settings: Settings) -> None:
    from mesh.identity.routers import router_endpoints
    from mesh.network import Network
    from mesh.network.connections import blocked_sessions_at, guard, report_traffic
    from mesh.network.endpoints import allow_sessions
    from mesh.starting import wait_for_files

    allow_sessions(settings.max_sessions)
    drops, blocked = Drops(), blocked_sessions_at(settings.blocked_sessions)
    async with Telemetry(settings.metrics_listen) as telemetry:
        await wait_for_files(settings)
        endpoints = router_endpoints(settings)
        while True:
            certificate = _own_certificate(endpoints)
            async with Network(endpoints) as network:
                # Served first: a reader of the announcement may ask for the health at once.
                with _serve_metrics(telemetry, network, drops):
                    announce(
                        log,
                        "router-started",
                        f"router {network.id} listens at {', '.join(settings.listen)}",
                        zenoh=network.id,
                    )
                    announce(log, "access-loaded", _describe_access(endpoints))
                    async with Background() as tasks:
                        if blocked is not None:
                            tasks.start(guard(network.session, blocked, drops), "blocked sessions")
                        tasks.start(report_traffic(network.session), "traffic")
                        tasks.start(drops.run(), "drops")
                        endpoints = await _wait_for_change(settings, endpoints, certificate)
            log.info(
                "the roster or the certificate changed: restarting the router", extra=log_event("router-restarted")
            )


def _serve_metrics(telemetry: Telemetry, network: Network, drops: Drops) -> AbstractContextManager[None]:
    """Serve a router's metrics and health: that it listens, its links, and what it dropped."""
    from mesh.network.metrics import drop_family, link_state, network_families

    async def measure() -> Iterable[MetricFamily]:
        return (*network_families(network), drop_family(drops))

    return telemetry.showing(measure=measure, health=lambda: {"router": link_state(network)})


async def _wait_for_change(settings: Settings, endpoints: Endpoints, certificate: bytes) -> Endpoints:
    """Wait until the roster or the certificate changes; the new endpoints. Invalid changes are logged and ignored."""
    from mesh.identity.routers import router_endpoints

    outages = OutageLog(log, "roster")
    while True:
        await asyncio.sleep(ROSTER_INTERVAL)
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


def _describe_access(endpoints: Endpoints) -> str:
    if endpoints.access is None:
        return "no roster: every client on this machine may do everything; other machines can't connect"
    return f"roster: {plural(len(endpoints.access['subjects']), 'member')} admitted by certificate"


def _roster(settings: Settings, path: Path | None) -> Roster:
    from mesh.identity import read_roster

    if path is None and not settings.roster:
        raise RosterMissing("no roster is set", hint="give --roster; `aira identity new --roster FILE` creates one")
    return read_roster(path or Path(settings.roster).expanduser())


def _access(roster: Roster) -> list[dict[str, Any]]:
    """The rights of each member; revoked members have none."""
    from mesh.identity import access_of

    found: dict[str, dict[str, list[str]]] = {member.address: {} for member in roster.member}
    for member, right, keys in access_of(roster):
        found[member.address][right.value] = list(keys)
    return [
        {
            "name": member.name,
            "address": member.address,
            "roles": list(member.roles),
            "revoked": member.revoked,
            "may": found[member.address],
        }
        for member in roster.member
    ]

"""`aira identity`: the certificates of a site and of its members."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Any

import click

from mesh.cli.options import FILE, FOLDER, FiniteRange, with_json, with_settings
from mesh.cli.output import print_result, printable
from mesh.errors import AiraError, ConfigurationError, InputError
from mesh.ops.identity.roster import ROLES
from mesh.role.running import report
from mesh.settings import NetworkSettings

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.ops.identity.certificates import CertificateFacts, SiteFolder
    from mesh.ops.identity.roster import Member
    from mesh.settings import Settings

DAYS = FiniteRange(0, 36_500, min_open=True)
SITE = click.option("--site", required=True, type=FOLDER, help="folder of the site, created by `aira identity site`")
ROSTER = click.option("--roster", type=FILE, help="roster file of the site, to update")


@click.group("identity")
def command() -> None:
    """Create and show the certificates by which a site's routers identify who connects.

    The common name of a certificate is an account's address. The roster, a TOML file, defines what its holder may do;
    set `revoked = true` there to exclude a member.
    """


@command.command("site", short_help="create a site")
@click.argument("folder", type=FOLDER)
@click.option("--name", default="AIRA mesh site", show_default=True, help="the site's name")
@click.option("--days", type=DAYS, default=3650, show_default=True, help="validity of its certificate, in days")
@with_json
def site(folder: Path, name: str, days: float, as_json: bool) -> None:
    """Create the certificate and the key of a site in FOLDER. Anyone with the key can admit members."""
    authority = _site(folder)
    authority.make(name=_text(name), days=days)
    facts = {"certificate": str(authority.certificate), "key": str(authority.key)}
    print_result(facts, facts, as_json=as_json)


@command.command("new", short_help="create a member's certificate and key")
@click.argument("folder", type=FOLDER)
@SITE
@click.option("--name", required=True, help="the member's name; for an edge agent, by default also its device's name")
@click.option("--address", help="the account's address [not needed for a router]")
@click.option("--keyfile", type=FILE, help="the account's keyfile, instead of its address")
@click.option(
    "--role", "roles", multiple=True, required=True, type=click.Choice(list(ROLES)), help="a role (repeatable)"
)
@click.option("--host", "hosts", multiple=True, help="for a router: a host name or IP address (may be repeated)")
@click.option("--agent", default="", help="for an edge agent: address of the agent that its device belongs to")
@click.option("--device", default="", help="for an edge agent: name of that device [the member's name]")
@click.option("--days", type=DAYS, default=90, show_default=True, help="validity of the certificate, in days")
@ROSTER
@with_json
def new(folder: Path, site: Path, days: float, roster: Path | None, as_json: bool, **about: Any) -> None:
    """Create a key and a certificate in FOLDER, and print the member's entry for the roster.

    With --roster, add the entry to that file instead. Keys are never shown, and files never overwritten.
    """
    facts, member = _create_member(folder, _site(site), days, roster, **about)
    _print(facts, as_json)
    if roster is None and not as_json:
        from mesh.ops.identity import entry_of

        click.echo(f"\n# for the roster:\n{entry_of(member)}", nl=False)


@command.command("show", short_help="show a certificate's holder and validity")
@click.argument("folder", type=FOLDER)
@click.option("--roster", type=FILE, help="roster of the site, in which to look up the member")
@with_json
def show(folder: Path, roster: Path | None, as_json: bool) -> None:
    """Print the name, address, roles, validity and fingerprint of the identity in FOLDER."""
    facts = _member(folder).facts()
    standing = _roster_state(facts, roster) if roster is not None else None
    _print(facts, as_json, standing)


@command.command("renew", short_help="issue a new certificate for the same member and key")
@click.argument("folders", metavar="FOLDER...", nargs=-1, required=True, type=FOLDER)
@SITE
@click.option("--within", type=DAYS, help="only certificates that expire within this many days [all]")
@click.option("--days", type=DAYS, default=90, show_default=True, help="validity of the new certificate, in days")
@ROSTER
@with_json
def renew(
    folders: tuple[Path, ...], site: Path, within: float | None, days: float, roster: Path | None, as_json: bool
) -> None:
    """Replace the certificate in each FOLDER by a new one for the same member and key. The key files are not needed.

    Open sessions continue, and use the new certificate when they next connect. With --within, certificates that expire
    later are not renewed, so a timer can run this. If one renewal fails, the others still run. With --roster, revoked
    members get no new certificate. --json prints an object for each FOLDER.
    """
    failed: AiraError | None = None
    for folder in folders:
        try:
            before = _member(folder).facts()
            is_due = within is None or before.left < timedelta(days=within)
            facts = _renew(folder, _site(site), days, roster) if is_due else before
        except AiraError as error:
            if failed is not None:
                report(failed)
            failed = error
            continue
        if is_due or as_json:
            _print(facts, as_json)
        else:
            click.echo(f"{printable(facts.holder.name)} is valid for {facts.left.days} more days")
    if failed is not None:
        raise failed


@command.command("check", short_help="check that the router admits this identity")
@click.option("--agent", default="", help="for an edge agent: address of the agent that its device belongs to")
@click.option("--device", default="", help="for an edge agent: name of that device")
@with_json
@with_settings(NetworkSettings)
async def check(settings: Settings, agent: str, device: str, as_json: bool) -> None:
    """Connect with the settings' certificate, and check that the router accepts this identity's messages.

    A router drops denied messages without an error. The exit code is 1 if it does not admit this identity, or denies
    all its operations.
    """
    if not settings.tls_certificate:
        hint = "give --tls-ca, --tls-certificate and --tls-key"
        raise ConfigurationError("no certificate is set", hint=hint, code="identity-missing")
    if bool(agent) != bool(device):
        raise InputError("--agent and --device must be given together", code="invalid-options")
    from mesh.network.endpoints import Endpoints
    from mesh.ops.identity.certificates import holder_address
    from mesh.ops.identity.routers import check_admission

    address = holder_address(settings.tls_certificate)

    await check_admission(Endpoints.from_settings(settings), address, agent=agent, device=device)
    result = {"admitted": True, "address": address, "routers": list(settings.connect)}
    shown = f"{', '.join(settings.connect)} admits {address} and forwards its messages"
    print_result(result, shown, as_json=as_json)


def _create_member(
    folder: Path, site: SiteFolder, days: float, roster: Path | None, **about: Any
) -> tuple[CertificateFacts, Member]:
    from msgspec.structs import replace

    from mesh.ops.identity.certificates import Holder, with_member, write_roster
    from mesh.ops.identity.roster import Member, entry_of, roster_from

    if "router" in about["roles"] and not about["hosts"]:
        raise InputError(
            "a router needs --host",
            hint="clients verify the host name or IP address in its certificate",
            code="invalid-options",
        )
    name, agent, device = (_text(about[field]) for field in ("name", "agent", "device"))
    roles = tuple(dict.fromkeys(about["roles"]))
    member = Member(name=name, address=_address(about), roles=roles, agent=agent, device=device)
    member = roster_from(entry_of(member), where="entry").member[0]
    if roster is not None:
        with_member(roster, member)  # raises if the roster can't hold the member
    holder = Holder(address=member.address, name=member.name, roles=member.roles, hosts=about["hosts"])
    facts = _member(folder).make(holder, site=site, days=days)
    member = replace(member, fingerprint=facts.fingerprint)
    if roster is not None:
        write_roster(roster, with_member(roster, member))
    return facts, member


def _renew(folder: Path, site: SiteFolder, days: float, roster: Path | None) -> CertificateFacts:
    from mesh.ops.identity.certificates import with_fingerprint, write_roster

    member = _member(folder)
    before: CertificateFacts = member.facts()
    address, old = before.holder.address, before.fingerprint
    if roster is not None:
        with_fingerprint(roster, address, old=old, new=old)  # raises for a revoked member
    facts: CertificateFacts = member.renew(site=site, days=days)
    if roster is not None:
        write_roster(roster, with_fingerprint(roster, address, old=old, new=facts.fingerprint))
    return facts


def _address(about: dict[str, Any]) -> str:
    import secrets

    if about["keyfile"] is not None:
        from mesh.cli.chain_client import address_in_keyfile

        if about["address"] is not None:
            raise InputError(
                "--address and --keyfile can't be used together", hint="give one of them", code="invalid-options"
            )
        return address_in_keyfile(about["keyfile"])
    if about["address"] is not None:
        return str(about["address"])
    if set(about["roles"]) == {"router"}:
        return "0x" + secrets.token_hex(20)  # a router has no account, but its name must be unique
    raise InputError("the address is missing", hint="give the account's --address or --keyfile", code="invalid-options")


def _roster_state(facts: CertificateFacts, path: Path) -> str:
    """The state of the certificate's holder in the roster."""
    from mesh.ops.identity import read_roster

    member = read_roster(path).find(facts.holder.address)
    if member is None:
        return "not in the roster"
    if member.revoked:
        return "revoked"
    if member.fingerprint and member.fingerprint != facts.fingerprint:
        return "in the roster, with another certificate"
    return f"in the roster as {', '.join(member.roles)}"


def _print(facts: CertificateFacts, as_json: bool, standing: str | None = None) -> None:
    holder, expired = facts.holder, facts.left.total_seconds() <= 0
    result = {
        "name": holder.name,
        "address": holder.address,
        "roles": holder.roles,
        "hosts": holder.hosts,
        "validFrom": facts.since.isoformat(),
        "validUntil": facts.until.isoformat(),
        "expired": expired,
        "fingerprint": facts.fingerprint,
        "roster": standing,
    }
    shown = {
        "name": printable(holder.name),
        "address": holder.address,
        "roles": printable(", ".join(holder.roles)),
        "hosts": printable(", ".join(holder.hosts)) or None,
        "valid from": facts.since.isoformat(" "),
        "valid until": f"{facts.until.isoformat(' ')} ({'expired' if expired else f'{facts.left.days} days left'})",
        "fingerprint": facts.fingerprint,
        "roster": standing,
    }
    print_result(result, shown, as_json=as_json)


def _text(text: str) -> str:
    if not text.isprintable() or len(text) > 64:
        raise InputError("a name is at most 64 printable characters", code="invalid-options")
    return text


def _site(folder: Path) -> SiteFolder:
    from mesh.ops.identity.certificates import SiteFolder

    return SiteFolder(folder)


def _member(folder: Path) -> Any:
    from mesh.ops.identity.certificates import MemberFolder

    return MemberFolder(folder)

"""Routers: the address of each (name, port, certificate), the own certificate, and a router's own roster.

Each address is checked separately, because a session to several routers hides a dead one. Everything here blocks, for a
few seconds at most.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.doctor.certificate import certificate_info, expiry_of, subject_values, tls_context
from mesh.doctor.checks import CheckResult, failed, passed, warning
from mesh.doctor.machine import SOON, time_left
from mesh.identity.roster import read_roster
from mesh.identity.routers import router_endpoints
from mesh.network import Tls
from mesh.network.endpoints import check_locators
from mesh.network.handshake import WILDCARD_HOSTS, refusal_by

if TYPE_CHECKING:
    from mesh.doctor.context import DoctorContext
    from mesh.settings import Settings

SECONDS: Final = 3.0
"""Seconds after which a router that has not answered counts as dead."""
PLACE: Final = re.compile(r"(?P<kind>tcp|tls)/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]+)):(?P<port>[0-9]+)")
LOOPBACK: Final = dict(zip(WILDCARD_HOSTS, ("127.0.0.1", "::1"), strict=True))
"""The address at which this machine reaches a router that listens on all addresses."""
OWN_FILES: Final = (
    "give --tls-ca, --tls-certificate and --tls-key of the router's site; `aira identity show` describes a certificate"
)


def check_router_address(locator: str, settings: Settings) -> CheckResult:
    """Whether a router answers at its address, and whether both accept each other's certificates.

    Raises `ConfigurationError` for a malformed address.
    """
    check_locators(locator)
    place = PLACE.match(locator)
    if place is None:
        return passed(f"{locator} can't be checked without a session; see the session check", code="not-checked")
    host, port = place["six"] or place["host"], int(place["port"])
    host = LOOPBACK.get(host, host)
    try:
        socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (socket.gaierror, UnicodeError):
        return failed(
            f"{locator}: can't resolve the name {host}",
            code="unresolvable",
            hint="check its spelling and this machine's DNS settings, or use the router's IP address",
        )
    began = time.monotonic()
    try:
        with socket.create_connection((host, port), SECONDS):
            pass
    except OSError as error:
        return _unanswered(locator, error)
    answers = f"{locator} answers in {(time.monotonic() - began) * 1000:.1f} ms"
    if place["kind"] == "tcp":
        return passed(answers)
    return _shown(locator, Tls.from_settings(settings), (host, port), answers)


def is_everywhere(locator: str) -> bool:
    """Whether a router listens on all addresses, so that its certificate does not name this locator."""
    place = PLACE.match(locator)
    return place is not None and place["kind"] == "tls" and (place["six"] or place["host"]) in WILDCARD_HOSTS


def check_certificate(context: DoctorContext) -> CheckResult:
    """Whether the own certificate can be used, and for how long. Raises `ConfigurationError` if it can't."""
    tls = Tls.from_settings(context.settings)
    if tls is None:
        return failed(
            "a tls/ endpoint needs the site's certificate, but none is set", code="no-certificate", hint=OWN_FILES
        )
    own = certificate_info(tls, mode="router" if context.role == "router" else "client")
    if own is None:
        return warning(
            "the site's certificate is set, but no certificate of our own",
            code="no-own-certificate",
            hint="ask the site's operator for a certificate, then " + OWN_FILES,
        )
    whose = f"{own.name or 'no name'}, {', '.join(own.roles) or 'no role'}, {own.address}"
    return _lasting(f"{whose}: valid", own.until, whose="own")


def check_roster(context: DoctorContext) -> CheckResult:
    """Whether the router's settings and roster can be used. Raises `ConfigurationError`."""
    router_endpoints(context.settings)
    if not context.settings.roster:
        return passed("none: the router listens on loopback only, and every client may do everything", code="no-roster")
    roster = read_roster(Path(context.settings.roster).expanduser())
    admitted = roster.admitted()
    if not admitted:
        return failed(
            f"{context.settings.roster} admits no member",
            code="no-members",
            hint="add one with `aira identity new FOLDER --site SITE --role ROLE --roster FILE`",
        )
    own = context.identity.address if context.identity is not None else ""
    if own and context.settings.link and own not in {member.address for member in admitted}:
        return failed(
            f"{own} is not in {context.settings.roster}, so the routers that this one links to deny all its operations",
            code="not-in-roster",
            hint="add it with the role router, there and to the rosters of those routers",
        )
    revoked = len(roster.member) - len(admitted)
    members = f"{len(admitted)} member{'' if len(admitted) == 1 else 's'}, {revoked or 'none'} revoked"
    return passed(f"{members}, markets {', '.join(roster.lighthouses)}")


def _unanswered(locator: str, error: OSError) -> CheckResult:
    if isinstance(error, ConnectionRefusedError):
        return failed(
            f"{locator}: no router listens there",
            code="no-router",
            hint="start one with `aira router`, or give another address with --connect tcp/HOST:PORT",
        )
    why = f"no answer within {SECONDS:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
    return failed(
        f"{locator}: {why}",
        code="no-answer",
        hint="check that the machine is on and reachable, and that its firewall allows the port",
    )


def _shown(locator: str, tls: Tls | None, place: tuple[str, int], answers: str) -> CheckResult:
    """The certificate that a TLS router presents, and whether it accepts ours."""
    if tls is None:
        return failed(
            f"{locator}: the router requires a certificate, but none is set",
            code="certificate-required",
            hint=OWN_FILES,
        )
    if (refusal := refusal_by(tls, locator, SECONDS)) is not None:
        return failed(
            f"{locator}: {refusal.text}",
            code=refusal.reason,
            hint=f"check that {tls.ca} is of this router's site; {OWN_FILES}",
        )
    certificate = _certificate_of(tls, place, named=not is_everywhere(locator))
    if certificate is None:
        return failed(
            f"{locator}: the TLS 1.3 handshake failed",
            code="handshake-failed",
            hint="check that this is the router's port, and that the router runs with --listen tls/HOST:PORT",
        )
    whose = next(
        iter(subject_values(certificate, "organizationName") + subject_values(certificate, "commonName")),
        "an unnamed holder",
    )
    shown = f"{answers}, accepts our certificate and presents that of {whose}"
    return _lasting(shown, expiry_of(certificate), whose="router")


def _certificate_of(tls: Tls, place: tuple[str, int], *, named: bool) -> dict[str, Any] | None:
    """The certificate that a router presents, verified against our site and, if `named`, against the host; None if
    the handshake fails."""
    context = tls_context(tls, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = named
    try:
        with (
            socket.create_connection(place, SECONDS) as connection,
            context.wrap_socket(connection, server_hostname=place[0]) as shaken,
        ):
            return shaken.getpeercert()
    except OSError:  # `ssl.SSLError` is one
        return None


def _lasting(words: str, until: float, *, whose: str) -> CheckResult:
    """The result for a certificate that expires then (seconds since the epoch)."""
    left = time_left(until)
    day = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(until))
    if until - time.time() > SOON:
        return passed(f"{words}, until {day} ({left})")
    renew = "`aira identity renew FOLDER --site SITE` where the site's key is; open sessions switch automatically"
    return warning(
        f"{words}, but only until {day} ({left})",
        code="certificate-expires",
        hint=f"renew the {whose} certificate: {renew}",
    )

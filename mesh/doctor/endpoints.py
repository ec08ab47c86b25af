"""Each router's address by itself: does its name resolve, does its port answer, whose certificate is it, is ours taken?

A session to several routers hides the one that is dead. Everything here blocks, for some seconds at most.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from typing import TYPE_CHECKING, Any, Final

from mesh.doctor.certificate import context_of, end_of, shown_by, texts_of
from mesh.doctor.clock import SOON, days_left
from mesh.doctor.findings import Finding, broken, doubtful, sound
from mesh.network import Tls
from mesh.network.endpoints import check_locators
from mesh.network.handshake import WILDCARD_HOSTS, refusal_reason

if TYPE_CHECKING:
    from mesh.doctor.case import Case
    from mesh.settings import Settings

SECONDS: Final = 3.0
"""In which a router answers, or is taken for dead."""
PLACE: Final = re.compile(r"(?P<kind>tcp|tls)/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]+)):(?P<port>[0-9]+)")
LOOPBACK: Final = dict(zip(WILDCARD_HOSTS, ("127.0.0.1", "::1"), strict=True))
"""Where this machine reaches who listens everywhere."""
OWN_FILES: Final = "give --tls-ca, --tls-certificate and --tls-key of its site; `aira identity show` tells of them"


def look_at(locator: str, settings: Settings) -> Finding:
    """What is to be found at a router's address. Raises `ConfigurationError` for what is no address."""
    check_locators(locator)
    place = PLACE.match(locator)
    if place is None:
        return sound(f"{locator} can't be tried by itself; the session shows whether it answers")
    host, port = place["six"] or place["host"], int(place["port"])
    host = LOOPBACK.get(host, host)
    try:
        socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (socket.gaierror, UnicodeError):
        return broken(
            f"{locator}: the name {host} is not known here",
            do="check its spelling and this machine's name server, or give the router's IP address",
        )
    began = time.monotonic()
    try:
        with socket.create_connection((host, port), SECONDS):
            pass
    except OSError as error:
        return _unanswered(locator, error)
    answers = f"{locator} answers in {(time.monotonic() - began) * 1000:.1f} ms"
    return (
        sound(answers)
        if place["kind"] == "tcp"
        else _shown(locator, Tls.from_settings(settings), (host, port), answers)
    )


def is_everywhere(locator: str) -> bool:
    """Whether a router that listens there can't be asked by a name that its certificate has."""
    place = PLACE.match(locator)
    return place is not None and place["kind"] == "tls" and (place["six"] or place["host"]) in WILDCARD_HOSTS


def look_at_certificate(case: Case) -> Finding:
    """Whether the own files can be used, and for how long. Raises `ConfigurationError` where they can't."""
    tls = Tls.from_settings(case.settings)
    if tls is None:
        return broken("a tls/ endpoint needs the site's certificate, and none is named", do=OWN_FILES)
    own = shown_by(tls, mode="router" if case.role == "router" else "client")
    if own is None:
        return doubtful(
            "there is the site's certificate, and none of our own",
            do="ask the site's operator for one, and " + OWN_FILES,
        )
    whose = f"{own.name or 'no name'}, {', '.join(own.roles) or 'no role'}, {own.address}"
    return _lasting(f"{whose}: valid", own.until, whose="own")


def _unanswered(locator: str, error: OSError) -> Finding:
    if isinstance(error, ConnectionRefusedError):
        return broken(
            f"{locator}: no router listens there",
            do="start one there with `aira router`, or name another with --connect tcp/HOST:PORT",
        )
    why = f"no answer within {SECONDS:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
    return broken(
        f"{locator}: {why}", do="is the machine on and on this network, and does its firewall let the port through?"
    )


def _shown(locator: str, tls: Tls | None, place: tuple[str, int], answers: str) -> Finding:
    """What a router behind TLS shows, and whether it takes what we show."""
    if tls is None:
        return broken(f"{locator}: the router wants to know who comes, and there is no certificate", do=OWN_FILES)
    if (why := refusal_reason(tls, locator, SECONDS)) is not None:
        return broken(f"{locator}: {why}", do=f"is this router of the site of {tls.ca}? {OWN_FILES}")
    certificate = _certificate_of(tls, place, named=not is_everywhere(locator))
    if certificate is None:
        return broken(
            f"{locator}: something listens there that makes no handshake (TLS 1.3)",
            do="is this the router's port, and is it a tls/ one? `aira router --listen tls/HOST:PORT` opens such",
        )
    whose = next(iter(texts_of(certificate, "organizationName") + texts_of(certificate, "commonName")), "nobody")
    shown = f"{answers}, takes our certificate and shows that of {whose}"
    return _lasting(shown, end_of(certificate), whose="router")


def _certificate_of(tls: Tls, place: tuple[str, int], *, named: bool) -> dict[str, Any] | None:
    """The certificate that a router shows, which is of our site, and if it is `named` for that host; None where there
    is none."""
    context = context_of(tls, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = named
    try:
        with (
            socket.create_connection(place, SECONDS) as connection,
            context.wrap_socket(connection, server_hostname=place[0]) as shaken,
        ):
            return shaken.getpeercert()
    except OSError:  # `ssl.SSLError` is one
        return None


def _lasting(words: str, until: float, *, whose: str) -> Finding:
    """A certificate that is good until then (seconds since 1970)."""
    left = days_left(until)
    day = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(until))
    if until - time.time() > SOON:
        return sound(f"{words}, until {day} ({left})")
    renew = "`aira identity renew FOLDER --site SITE` where the site's key is; sessions take the new one by themselves"
    return doubtful(f"{words}, but only until {day} ({left})", do=f"renew the {whose} certificate: {renew}")

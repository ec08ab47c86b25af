"""A site's router, from the settings and the roster: as this program runs it, and as `zenohd` does."""

from __future__ import annotations

import json
import re
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import ConfigurationError
from mesh.identity.roster import read_roster
from mesh.identity.zenoh_rules import access_control
from mesh.network import Tls
from mesh.network.endpoints import Endpoints, check_locators

if TYPE_CHECKING:
    from mesh.settings import Settings

HOST: Final = re.compile(r"\w+/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]*)):")
LOCAL: Final = ("unixsock-stream/", "unixpipe/")
"""How locators begin that only this machine reaches."""


def router_endpoints(settings: Settings) -> Endpoints:
    """Where a site's router listens, as whom, and who may do what there.

    With a roster it listens on `tls/` only, and lets in who has a certificate of the site. Without one it listens on
    loopback only. Raises `ConfigurationError`.
    """
    if not settings.roster:
        check_loopback((*settings.listen, *settings.link))
        return Endpoints(mode="router", listen=settings.listen, connect=settings.link, tls=Tls.from_settings(settings))
    roster = read_roster(Path(settings.roster).expanduser())
    for locator in (*settings.listen, *settings.link):
        if not locator.startswith("tls/"):
            raise ConfigurationError(
                f"{locator} does not tell who connects, and there is a roster", hint="write it as tls/HOST:PORT"
            )
    tls = Tls.from_settings(settings)
    if tls is None:
        raise ConfigurationError(
            "a router with a roster needs the site's certificate, its own and its key",
            hint="give --tls-ca, --tls-certificate and --tls-key; `aira identity new --role router` makes them",
        )
    access = access_control(roster)
    return Endpoints(mode="router", listen=settings.listen, connect=settings.link, tls=tls, access=access)


def check_loopback(listen: tuple[str, ...]) -> None:
    """Raise `ConfigurationError` for a locator that other machines reach, and for what is none."""
    check_locators(*listen)
    for locator in listen:
        if not is_loopback(locator):
            raise ConfigurationError(
                f"without a roster a router listens on loopback only, and {locator} is open to everybody",
                hint="listen on tcp/127.0.0.1:7447, or give --roster; `aira identity new --roster FILE` begins one",
            )


def is_loopback(locator: str) -> bool:
    """Whether only this machine reaches a locator."""
    if locator.startswith(LOCAL):
        return True
    place = HOST.match(locator)
    host = (place["six"] or place["host"]) if place is not None else ""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def zenohd_configuration(endpoints: Endpoints) -> str:
    """The same router as a configuration file (JSON5) of `zenohd`. Raises `ConfigurationError` for what can't work."""
    endpoints.config()
    nested: dict[str, Any] = {}
    for path, value in endpoints.options().items():
        *sections, name = path.split("/")
        section = nested
        for each in sections:
            section = section.setdefault(each, {})
        section[name] = value
    heading = "// Made by `aira router config`; zenohd reads it when it starts: zenohd --config FILE\n"
    return heading + json.dumps(nested, indent=2) + "\n"

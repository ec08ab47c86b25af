"""How the page is served, and to whom."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from bridges.web.errors import NotOpenToOthers

STATIC: Final = Path(__file__).with_name("static")
"""The folder of the built page."""


@dataclass(frozen=True, kw_only=True)
class WebOptions:
    """How the page is served."""

    host: str = "127.0.0.1"
    port: int = 8585
    names: tuple[str, ...] = ()
    """Names besides its own address by which browsers reach it: `HOST` at any port, or `HOST:PORT`."""
    token: str = field(default="", repr=False)
    """What people log in with; empty: no login."""
    operator_token: str = field(default="", repr=False)
    certificate: str = ""
    key: str = ""
    roster: str = ""
    """The site's roster: members who show a certificate of `ca` need no token, and its operators are operators."""
    ca: str = ""
    embed: tuple[str, ...] = ()
    """Origins that may show the page in a frame."""
    robot: dict[str, Any] | None = None
    """The one robot that the page orders from: see Robot in openapi.json."""
    explorer: str = ""
    from_block: int = 0
    static: Path = STATIC

    def check(self) -> None:
        """Raise `NotOpenToOthers` for a server that other machines can reach without TLS and login."""
        if self.roster and not (self.certificate and self.key and self.ca):
            raise NotOpenToOthers(
                "members of a roster log in by TLS", hint="with --roster give --certificate, --key and --tls-ca"
            )
        if not is_loopback(self.host) and not (self.certificate and self.key and self.has_login):
            raise NotOpenToOthers(
                f"other machines can reach {self.host}: that needs TLS and a login",
                hint="give --certificate, --key and --token-file or --roster, or listen on 127.0.0.1",
            )

    @property
    def has_login(self) -> bool:
        """Whether people, or operators only, can log in."""
        return bool(self.token or self.operator_token or self.roster)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"

"""How Foxglove is served, and to whom."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from bridges.web.errors import NotOpenToOthers
from bridges.web.options import is_loopback

PORT: Final = 8765
"""Where Foxglove looks for a server."""
APPS: Final = ("https://app.foxglove.dev", "file://")
"""The sites that may connect: Foxglove in the browser, and applications that are no site."""


@dataclass(frozen=True, kw_only=True)
class FoxgloveOptions:
    """How Foxglove is served."""

    host: str = "127.0.0.1"
    port: int = PORT
    token: str = field(default="", repr=False)
    """What a client shows at the end of the address, `?token=…`; empty: nothing."""
    certificate: str = ""
    key: str = ""
    origins: tuple[str, ...] = ()
    """Other sites than `APPS` that may connect."""

    def check(self) -> None:
        """Raise `NotOpenToOthers` for a server that other machines can reach without TLS and a token."""
        if not is_loopback(self.host) and not (self.certificate and self.key and self.token):
            raise NotOpenToOthers(
                f"other machines can reach {self.host}: that needs TLS and a token",
                hint="give --certificate, --key and --token-file, or listen on 127.0.0.1",
            )

"""Who a session is on `tls/` endpoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Tls:
    """The files of one identity: the site's certificate, the own one and its key (paths, PEM).

    A client may leave out the last two, and is let in only where nobody has to show who he is. Zenoh reads the files
    at every connection that it makes, and so takes a renewed certificate by itself.
    """

    ca: Path
    certificate: Path | None = None
    key: Path | None = None

    @property
    def pair(self) -> tuple[Path, Path] | None:
        """The own certificate and its key."""
        return None if self.certificate is None or self.key is None else (self.certificate, self.key)

    def options(self, mode: str) -> dict[str, object]:
        """Zenoh's options below `transport/link/tls` for a session in this mode. Paths are absolute."""
        options: dict[str, object] = {
            "root_ca_certificate": str(self.ca.absolute()),
            "enable_mtls": self.pair is not None,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        if self.pair is not None:
            certificate, key = (str(path.absolute()) for path in self.pair)
            for use in ("connect", "listen") if mode == "router" else ("connect",):
                options |= {f"{use}_certificate": certificate, f"{use}_private_key": key}
        return options

"""The TLS identity of a session."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from mesh.settings import NetworkSettings


def unusable(why: str, *, hint: str = "`aira identity new` creates it") -> ConfigurationError:
    """The error that the files of the TLS identity can't be used."""
    return ConfigurationError(why, hint=hint, code="tls-unusable")


@dataclass(frozen=True, kw_only=True)
class Tls:
    """The certificate files of one identity (paths, PEM): the site's, the session's own, and its key.

    A client may omit the last two; then only a router that requires no client certificate accepts it. Zenoh reads the
    files on every connection, so a renewed certificate takes effect without a restart.
    """

    ca: Path
    certificate: Path | None = None
    key: Path | None = None

    @classmethod
    def from_settings(cls, settings: NetworkSettings) -> Tls | None:
        """The identity that the settings name, None if they name none. Raises `ConfigurationError`."""
        if not settings.tls_ca and (settings.tls_certificate or settings.tls_key):
            raise unusable("tls_certificate is set, but tls_ca is not", hint="add --tls-ca")
        if not settings.tls_ca:
            return None
        return cls(
            ca=Path(settings.tls_ca).expanduser(),
            certificate=Path(settings.tls_certificate).expanduser() if settings.tls_certificate else None,
            key=Path(settings.tls_key).expanduser() if settings.tls_key else None,
        )

    @property
    def pair(self) -> tuple[Path, Path] | None:
        """The session's own certificate and its key, None without them."""
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

"""The TLS identity of a session: its files, their check before a session opens, and why a handshake failed.

Zenoh reports a failed handshake only as a missing connection. Therefore the files are checked before Zenoh reads them,
and after a failure Python's own TLS repeats the handshake to find the reason.
"""

from __future__ import annotations

import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from mesh.errors import ConfigurationError
from mesh.network.locators import LOCATOR, WILDCARD_HOSTS

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


class TlsRefusal(NamedTuple):
    """Why a router and an identity reject each other: a word for programs and a sentence for people."""

    reason: Literal["certificate-required", "other-site", "expired", "rejected", "untrusted", "wrong-host"]
    text: str


OTHER_SITE: Final = TlsRefusal("other-site", "the certificate is not from its site")
REJECTED: Final = TlsRefusal("rejected", "it rejects the certificate")
ALERTS: Final = {
    "CERTIFICATE_REQUIRED": TlsRefusal("certificate-required", "it requires a certificate"),
    "UNKNOWN_CA": OTHER_SITE,
    "CERTIFICATE_EXPIRED": TlsRefusal("expired", "the certificate has expired"),
    "CERTIFICATE_UNKNOWN": REJECTED,
    "BAD_CERTIFICATE": REJECTED,
    "DECRYPT_ERROR": OTHER_SITE,
}
"""What each TLS alert means with which a router ends the handshake."""


def check_files(tls: Tls, *, mode: str) -> dict[str, Any] | None:
    """The session's own certificate, as `ssl` represents it; None without one.

    `mode` is the mode of the session that uses the files: `router` or `client`. Raises `ConfigurationError` for files
    that can't work: missing, malformed, expired, or not matching.
    """
    if (tls.certificate is None) != (tls.key is None):
        raise unusable("only one of tls_certificate and tls_key is set")
    if tls.certificate is None and mode == "router":
        raise unusable("a router needs a certificate for tls/", hint="add --tls-certificate and --tls-key")
    for what, path in (("site's certificate", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        try:
            if path is not None:
                path.read_bytes()
        except OSError as error:
            raise unusable(f"can't read the {what} {path}: {error.strerror}") from None
    if tls.certificate is not None:
        return _checked_certificate(tls, mode)
    _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    return None


def shake_hands(tls: Tls, locator: str, seconds: float) -> dict[str, Any] | TlsRefusal | None:
    """The certificate of the router at a `tls/` locator, or why it and this identity reject each other.

    None if nothing answers there within `seconds`, or if the handshake fails for another reason. Blocks.
    """
    address = LOCATOR.fullmatch(locator)
    if address is None or address["protocol"] != "tls":
        return None
    host = address["six"] or address["host"]
    context = _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = host not in WILDCARD_HOSTS
    try:
        with socket.create_connection((host, int(address["port"])), seconds) as connection:
            return _handshake(context, connection, host)
    except OSError:
        return None


def _handshake(context: ssl.SSLContext, connection: socket.socket, host: str) -> dict[str, Any] | TlsRefusal | None:
    """With TLS 1.3 the client finishes first; the router's rejection arrives in place of data."""
    certificate = None
    try:
        with context.wrap_socket(connection, server_hostname=host) as secured:
            certificate = secured.getpeercert()
            secured.settimeout(1)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        text = f"its certificate is not trusted: {error.verify_message.rstrip('.')}"
        names_another_host = error.verify_code == 62  # OpenSSL's X509_V_ERR_HOSTNAME_MISMATCH
        return TlsRefusal("wrong-host" if names_another_host else "untrusted", text)
    except ssl.SSLError as error:
        reason = error.reason or ""
        return next((refusal for alert, refusal in ALERTS.items() if reason.endswith(alert)), None)
    except OSError:
        pass  # it has nothing to say, or is gone
    return certificate


def _checked_certificate(tls: Tls, mode: str) -> dict[str, Any] | None:
    """The certificate as the other side sees it, by a handshake with itself in memory."""
    client, server = _context(tls, ssl.PROTOCOL_TLS_CLIENT), _context(tls, ssl.PROTOCOL_TLS_SERVER)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_REQUIRED if mode == "router" else ssl.CERT_NONE
    server.verify_mode = ssl.CERT_NONE if mode == "router" else ssl.CERT_REQUIRED
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(to_client, to_server), server.wrap_bio(to_server, to_client, server_side=True))
    for end in (*ends, *ends):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError as error:
            why = f"the certificate {tls.certificate} can't be used: {_explained(error, tls)}"
            hint = "`aira identity show` prints its contents, `aira identity renew` renews it"
            raise unusable(why, hint=hint) from None
    return ends[mode != "router"].getpeercert()


def _explained(error: ssl.SSLCertVerificationError, tls: Tls) -> str:
    said = error.verify_message
    if any(word in said for word in ("issuer", "self-signed", "signature")):
        return f"it is not from the site of {tls.ca}"
    return said.replace("certificate", "it", 1)


def _context(tls: Tls, protocol: ssl._SSLMethod) -> ssl.SSLContext:
    """TLS settings like Zenoh's. Raises `ConfigurationError` for files that are not PEM, or don't match."""
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError:
        raise unusable(f"the site's certificate {tls.ca} is not a PEM certificate") from None
    if tls.pair is not None:
        try:
            context.load_cert_chain(*tls.pair, password=_no_password)
        except ssl.SSLError as error:
            if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
                why = f"the key {tls.key} does not belong to the certificate {tls.certificate}"
            else:
                why = f"the certificate {tls.certificate} or its key {tls.key} is not PEM, or has a password"
            raise unusable(why) from None
    return context


def _no_password() -> str:
    """Zenoh could not supply one either, and without this OpenSSL would prompt on the terminal."""
    return ""

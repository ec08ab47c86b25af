"""Diagnosis of TLS identities: checks certificate files before a session opens, and explains a failed handshake.

Zenoh reports a failed handshake only as a missing connection. Therefore the files are checked before Zenoh reads them,
and after a failure Python's own TLS repeats the handshake to find the reason.
"""

from __future__ import annotations

import re
import socket
import ssl
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from mesh.network._tls import unusable

if TYPE_CHECKING:
    from mesh.network._tls import Tls

LOCATOR: Final = re.compile(r"tls/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]+)):(?P<port>[0-9]+)")
WILDCARD_HOSTS: Final = ("0.0.0.0", "::")
"""Hosts that stand for all of a router's addresses; no certificate names them."""
ALERT_TIMEOUT: Final = 1.0
"""Seconds in which a router that rejects the certificate says so after the handshake."""
HOSTNAME_MISMATCH: Final = 62
"""OpenSSL's number of the error that a certificate names another host."""


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


def check_files(tls: Tls, *, mode: str) -> None:
    """Raise `ConfigurationError` for files that can't work: missing, malformed, expired, or not matching.

    `mode` is the mode of the session that uses them: `router` or `client`.
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
    if tls.certificate is None:
        _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    else:
        _check_certificate(tls, mode)


def refusal_by(tls: Tls, locator: str, seconds: float) -> TlsRefusal | None:
    """Why the router at a `tls/` locator and this identity reject each other.

    None if nothing answers there within `seconds`, or if the handshake succeeds. Blocks.
    """
    address = LOCATOR.match(locator)
    if address is None:
        return None
    host = address["six"] or address["host"]
    context = _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = host not in WILDCARD_HOSTS
    try:
        with socket.create_connection((host, int(address["port"])), seconds) as connection:
            return _handshake(context, connection, host)
    except OSError:
        return None


def _handshake(context: ssl.SSLContext, connection: socket.socket, host: str) -> TlsRefusal | None:
    """With TLS 1.3 the client finishes first; the router's rejection arrives in place of data."""
    try:
        with context.wrap_socket(connection, server_hostname=host) as secured:
            secured.settimeout(ALERT_TIMEOUT)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        text = f"its certificate is not trusted: {error.verify_message.rstrip('.')}"
        return TlsRefusal("wrong-host" if error.verify_code == HOSTNAME_MISMATCH else "untrusted", text)
    except ssl.SSLError as error:
        reason = error.reason or ""
        return next((refusal for alert, refusal in ALERTS.items() if reason.endswith(alert)), None)
    except OSError:
        return None
    return None


def _check_certificate(tls: Tls, mode: str) -> None:
    """Check the certificate as the other side will, by a handshake with itself in memory."""
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


def _explained(error: ssl.SSLCertVerificationError, tls: Tls) -> str:
    said = error.verify_message
    if any(word in said for word in ("issuer", "self-signed", "signature")):
        return f"it is not from the site of {tls.ca}"
    return said.replace("certificate", "it", 1)


def _context(tls: Tls, protocol: ssl._SSLMethod) -> ssl.SSLContext:
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

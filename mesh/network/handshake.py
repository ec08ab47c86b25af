"""What is wrong with an identity, before a session is opened, and why a router did not let it in, after.

Zenoh says of a failed handshake only that there is no connection. So the files are looked at before it gets them, and
when a session could not be opened, the handshake is made once more by Python's own TLS.
"""

from __future__ import annotations

import re
import socket
import ssl
from typing import TYPE_CHECKING, Final

from mesh.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.network.tls import Tls

MAKE: Final = "`aira identity new` makes it"
LOCATOR: Final = re.compile(r"tls/(?:\[(?P<six>[^\]]+)\]|(?P<host>[^:]+)):(?P<port>[0-9]+)")
EVERYWHERE: Final = ("0.0.0.0", "::")
"""Hosts at which a router listens for whoever comes by any of its names: no certificate is for one of these."""
VERDICT: Final = 1.0
"""Seconds in which a router, after the handshake, says that it does not take the certificate."""
ALERTS: Final = {
    "CERTIFICATE_REQUIRED": "it lets nobody in without a certificate",
    "UNKNOWN_CA": "the certificate is not from its site",
    "CERTIFICATE_EXPIRED": "the certificate has expired",
    "CERTIFICATE_UNKNOWN": "it does not take the certificate",
    "BAD_CERTIFICATE": "it does not take the certificate",
    "DECRYPT_ERROR": "the certificate is not from its site",
}
"""What a router means by the alert with which it ends a handshake."""


def check_files(tls: Tls, *, mode: str) -> None:
    """Raise `ConfigurationError` for files that can't work: missing, malformed, expired, or not of one another.

    `mode` says whose they are: `router` or `client`.
    """
    if (tls.certificate is None) != (tls.key is None):
        raise ConfigurationError("of tls_certificate and tls_key only one is set", hint=MAKE)
    if tls.certificate is None and mode == "router":
        raise ConfigurationError("a router needs a certificate for tls/", hint="give --tls-certificate and --tls-key")
    for what, path in (("site's certificate", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        if path is not None:
            _check_readable(what, path)
    if tls.certificate is None:
        _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    else:
        _check_certificate(tls, mode)


def refusal(tls: Tls, locator: str, seconds: float) -> str | None:
    """Why the router at a `tls/` locator and this identity do not come together.

    None if nobody answers there within so many seconds, or if nothing is wrong. Blocks.
    """
    place = LOCATOR.match(locator)
    if place is None:
        return None
    host = place["six"] or place["host"]
    context = _context(tls, ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = host not in EVERYWHERE
    try:
        with socket.create_connection((host, int(place["port"])), seconds) as connection:
            return _verdict(context, connection, host)
    except OSError:
        return None


def _verdict(context: ssl.SSLContext, connection: socket.socket, host: str) -> str | None:
    """With TLS 1.3 the client is done first: what the router thinks of it comes in place of data."""
    try:
        with context.wrap_socket(connection, server_hostname=host) as shaken:
            shaken.settimeout(VERDICT)
            shaken.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"its own certificate is not to be trusted: {error.verify_message.rstrip('.')}"
    except ssl.SSLError as error:
        reason = error.reason or ""
        return next((why for alert, why in ALERTS.items() if reason.endswith(alert)), None)
    except OSError:
        return None
    return None


def _check_certificate(tls: Tls, mode: str) -> None:
    """Have the own certificate looked at as the other side will: in a handshake with itself, in memory."""
    client, server = _context(tls, ssl.PROTOCOL_TLS_CLIENT), _context(tls, ssl.PROTOCOL_TLS_SERVER)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_REQUIRED if mode == "router" else ssl.CERT_NONE
    server.verify_mode = ssl.CERT_NONE if mode == "router" else ssl.CERT_REQUIRED
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True))
    for end in (*ends, *ends):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError as error:
            raise ConfigurationError(
                f"the certificate {tls.certificate} is of no use: {_explained(error, tls)}",
                hint="`aira identity show` tells what it holds, `aira identity renew` renews it",
            ) from None


def _explained(error: ssl.SSLCertVerificationError, tls: Tls) -> str:
    why = error.verify_message
    if any(word in why for word in ("issuer", "self-signed", "signature")):
        return f"it is not from the site of {tls.ca}"
    return why.replace("certificate", "it", 1)


def _context(tls: Tls, protocol: ssl._SSLMethod) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError:
        raise ConfigurationError(f"the site's certificate {tls.ca} is no certificate (PEM)", hint=MAKE) from None
    if tls.pair is not None:
        try:
            context.load_cert_chain(*tls.pair, password=_no_password)
        except ssl.SSLError as error:
            raise _unusable(tls, error) from None
    return context


def _unusable(tls: Tls, error: ssl.SSLError) -> ConfigurationError:
    if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
        return ConfigurationError(f"the key {tls.key} does not belong to the certificate {tls.certificate}", hint=MAKE)
    return ConfigurationError(
        f"the certificate {tls.certificate} or its key {tls.key} is not PEM, or has a password", hint=MAKE
    )


def _check_readable(what: str, path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"can't read the {what} {path}: {error.strerror}", hint=MAKE) from None


def _no_password() -> str:
    """Zenoh could not give one either, and OpenSSL would ask for it on the terminal."""
    return ""

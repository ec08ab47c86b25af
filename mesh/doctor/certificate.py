"""The own certificate: its holder and its expiry. Uses Python's `ssl` only: edge machines have no other library."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mesh.errors import AiraError, ConfigurationError, InvalidAddress
from mesh.network import Tls
from mesh.network.handshake import check_files
from schemas.address import parse_address

if TYPE_CHECKING:
    from mesh.settings import Settings


@dataclass(frozen=True, kw_only=True)
class CertificateInfo:
    """The content of a certificate: its holder's address (as in keys), name and roles, and when it expires (seconds
    since the epoch)."""

    address: str
    name: str
    roles: tuple[str, ...]
    until: float


def certificate_info(tls: Tls, *, mode: str) -> CertificateInfo | None:
    """Read the own certificate; None if there is none. `mode` is `router` or `client`.

    Raises `ConfigurationError` for unusable files, and for a certificate whose common name is not an address.
    """
    check_files(tls, mode=mode)
    if tls.pair is None:
        return None
    subject = _peer_certificate(tls)
    (address, *_) = subject_values(subject, "commonName") or ("",)
    try:
        address = parse_address(address).lower()
    except InvalidAddress:
        raise ConfigurationError(
            f"the common name of the certificate {tls.certificate} is {address!r}, not an address",
            hint="create a certificate with `aira identity new`",
        ) from None
    return CertificateInfo(
        address=address,
        name=next(iter(subject_values(subject, "organizationName")), ""),
        roles=subject_values(subject, "organizationalUnitName"),
        until=expiry_of(subject),
    )


def own_identity(settings: Settings) -> CertificateInfo | None:
    """Read the certificate of the settings; None also if it is unusable, which a check reports."""
    try:
        tls = Tls.from_settings(settings)
        return None if tls is None else certificate_info(tls, mode="client")
    except AiraError:
        return None


def subject_values(certificate: dict[str, Any], name: str) -> tuple[str, ...]:
    """The values of a subject field of a certificate, as `ssl` represents it."""
    return tuple(str(text) for part in certificate.get("subject", ()) for key, text in part if key == name)


def expiry_of(certificate: dict[str, Any]) -> float:
    """Its expiry, in seconds since the epoch."""
    return float(ssl.cert_time_to_seconds(str(certificate["notAfter"])))


def tls_context(tls: Tls, protocol: ssl._SSLMethod) -> ssl.SSLContext:
    """TLS settings like Zenoh's, with files that were checked before."""
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_verify_locations(tls.ca)
    if tls.pair is not None:
        context.load_cert_chain(*tls.pair)
    return context


def _peer_certificate(tls: Tls) -> dict[str, Any]:
    """Read the own certificate by a handshake with itself, in memory."""
    client, server = tls_context(tls, ssl.PROTOCOL_TLS_CLIENT), tls_context(tls, ssl.PROTOCOL_TLS_SERVER)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_NONE
    server.verify_mode = ssl.CERT_REQUIRED
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    asking, answering = client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)
    for end in (asking, answering, asking, answering):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
    return answering.getpeercert() or {}

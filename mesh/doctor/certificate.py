"""The own certificate: whose it is, and how long it lasts, by Python's TLS: an edge machine has no other library."""

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
class Shown:
    """What a certificate says: the address that it is for (as in keys), its holder's name and roles, and when it ends
    (seconds since 1970)."""

    address: str
    name: str
    roles: tuple[str, ...]
    until: float


def shown_by(tls: Tls, *, mode: str) -> Shown | None:
    """What the own certificate says; None where there is none. `mode` is `router` or `client`.

    Raises `ConfigurationError` for files that can't be used, and for a certificate that is for no address.
    """
    check_files(tls, mode=mode)
    if tls.pair is None:
        return None
    said = _peer_certificate(tls)
    (address, *_) = texts_of(said, "commonName") or ("",)
    try:
        address = parse_address(address).lower()
    except InvalidAddress:
        raise ConfigurationError(
            f"the certificate {tls.certificate} is for {address or 'nobody'!r}, and not for an address",
            hint="`aira identity new` makes certificates by which routers know an account",
        ) from None
    return Shown(
        address=address,
        name=next(iter(texts_of(said, "organizationName")), ""),
        roles=texts_of(said, "organizationalUnitName"),
        until=end_of(said),
    )


def own_identity(settings: Settings) -> Shown | None:
    """The same for the settings' certificate; None also where it is of no use, which is for a check to find."""
    try:
        tls = Tls.from_settings(settings)
        return None if tls is None else shown_by(tls, mode="client")
    except AiraError:
        return None


def texts_of(certificate: dict[str, Any], name: str) -> tuple[str, ...]:
    """What a certificate, as `ssl` gives it, says of its holder under that name."""
    return tuple(str(text) for part in certificate.get("subject", ()) for key, text in part if key == name)


def end_of(certificate: dict[str, Any]) -> float:
    """When it ends, in seconds since 1970."""
    return float(ssl.cert_time_to_seconds(str(certificate["notAfter"])))


def context_of(tls: Tls, protocol: ssl._SSLMethod) -> ssl.SSLContext:
    """TLS as Zenoh speaks it, with files that were checked."""
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_verify_locations(tls.ca)
    if tls.pair is not None:
        context.load_cert_chain(*tls.pair)
    return context


def _peer_certificate(tls: Tls) -> dict[str, Any]:
    """The own certificate as another sees it: in a handshake with itself, in memory."""
    client, server = context_of(tls, ssl.PROTOCOL_TLS_CLIENT), context_of(tls, ssl.PROTOCOL_TLS_SERVER)
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

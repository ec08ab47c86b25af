"""Certificates: a site's own, and those of its members, whose common name is the account's address.

A site's certificate signs all others. Keys are ECDSA P-256, which every TLS library supports. A member's certificate
also has its name (organization) and roles (organizational units), for people to read: only the roster gives rights.
Everything here is in memory; needs the extra `identity`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import InputError, InvalidAddress
from mesh.extras import needs_extra
from mesh.identity.errors import IdentityError
from schemas.address import parse_address

with needs_extra("identity", "a certificate"):
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    Key = ec.EllipticCurvePrivateKey

EARLIER: Final = timedelta(minutes=5)
"""A certificate is valid from this long before its creation, because clocks differ."""
USES: Final = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH])
HOST_NAME: Final = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")
NO_OTHER_USAGE: Final = {
    "content_commitment": False,
    "key_encipherment": False,
    "data_encipherment": False,
    "key_agreement": False,
    "encipher_only": False,
    "decipher_only": False,
}


@dataclass(frozen=True, kw_only=True)
class Holder:
    """The holder of a member's certificate. `hosts` are the names and IP addresses of a router."""

    address: str
    name: str = ""
    roles: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class CertificateFacts:
    """The content of a member's certificate. `fingerprint` is SHA-256 of the certificate, 64 hexadecimal digits."""

    holder: Holder
    since: datetime
    until: datetime
    fingerprint: str

    @property
    def left(self) -> timedelta:
        """How long it is still valid; not positive once it has expired."""
        return self.until - datetime.now(UTC)


def new_key() -> Key:
    """A new private key."""
    return ec.generate_private_key(ec.SECP256R1())


def site_certificate(key: Key, name: str, days: float) -> x509.Certificate:
    """A site's own certificate, signed with its own key, valid for `days`."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    usage = x509.KeyUsage(digital_signature=True, key_cert_sign=True, crl_sign=True, **NO_OTHER_USAGE)
    return (
        _builder(subject, subject, key.public_key(), days, issuer_key=key)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )


def member_certificate(
    holder: Holder, public_key: Any, *, site: x509.Certificate, site_key: Key, days: float
) -> x509.Certificate:
    """A certificate for a member's public key, signed by the site, valid for `days` but not longer than the site's."""
    attributes = [
        (NameOID.COMMON_NAME, holder.address),
        *((NameOID.ORGANIZATION_NAME, name) for name in (holder.name,) if name),
        *((NameOID.ORGANIZATIONAL_UNIT_NAME, role) for role in holder.roles),
    ]
    subject = x509.Name([x509.NameAttribute(*attribute) for attribute in attributes])
    remaining = (site.not_valid_after_utc - datetime.now(UTC)) / timedelta(days=1)
    usage = x509.KeyUsage(digital_signature=True, key_cert_sign=False, crl_sign=False, **NO_OTHER_USAGE)
    builder = (
        _builder(subject, site.subject, public_key, min(days, remaining), issuer_key=site_key)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(USES, critical=False)
    )
    if holder.hosts:
        names = x509.SubjectAlternativeName([_host(host) for host in holder.hosts])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(site_key, hashes.SHA256())


def facts_of(certificate: x509.Certificate, path: Path) -> CertificateFacts:
    """Read a member's certificate. Raises `IdentityError` if its common name is not an address; `path` is its file."""
    names = _texts(certificate, NameOID.COMMON_NAME)
    try:
        address = parse_address(names[0] if names else "")
    except InvalidAddress:
        shown = repr(names[0]) if names else "empty"
        raise IdentityError(path, f"the common name of the certificate is {shown}, not an address") from None
    holder = Holder(
        address=address.lower(),
        name=next(iter(_texts(certificate, NameOID.ORGANIZATION_NAME)), ""),
        roles=tuple(_texts(certificate, NameOID.ORGANIZATIONAL_UNIT_NAME)),
        hosts=_hosts(certificate),
    )
    return CertificateFacts(
        holder=holder,
        since=certificate.not_valid_before_utc,
        until=certificate.not_valid_after_utc,
        fingerprint=certificate.fingerprint(hashes.SHA256()).hex(),
    )


def holder_address(file: str) -> str:
    """The address (lower case) of the holder of a member's certificate in a PEM file. Raises `IdentityError`."""
    path = Path(file).expanduser()
    return facts_of(read_certificate(path), path).holder.address


def certificate_bytes(certificate: x509.Certificate) -> bytes:
    """As PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_bytes(key: Key) -> bytes:
    """A private key as PEM (PKCS 8), without a password, which Zenoh does not support. Write it only to a file of mode
    0600."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def read_certificate(path: Path) -> x509.Certificate:
    """Read the first certificate of a file. Raises `IdentityError`."""
    try:
        return x509.load_pem_x509_certificate(_contents(path))
    except ValueError:
        raise IdentityError(path, "this is not a certificate (PEM)") from None


def read_key(path: Path) -> Key:
    """Read the key of a file. Raises `IdentityError`, which does not show the key."""
    try:
        key = serialization.load_pem_private_key(_contents(path), password=None)
    except (ValueError, TypeError):  # TypeError: it has a password
        raise IdentityError(path, "this is not a private key (PEM, without password)") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise IdentityError(path, "this is not an elliptic curve key")
    return key


def check_pair(certificate: x509.Certificate, key: Key, path: Path) -> None:
    """Raise `IdentityError` if the key in `path` is not the certificate's."""
    if certificate.public_key() != key.public_key():
        raise IdentityError(path, "the key does not belong to the certificate")


def _builder(
    subject: x509.Name, issuer: x509.Name, public_key: Any, days: float, *, issuer_key: Key
) -> x509.CertificateBuilder:
    """What all certificates have. TLS clients ask for the identifiers of both keys, as Python does from 3.13 on."""
    now = datetime.now(UTC)
    subject_id = x509.SubjectKeyIdentifier.from_public_key(public_key)
    issuer_id = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key())
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(subject_id, critical=False)
        .add_extension(issuer_id, critical=False)
    )


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        pass
    if not HOST_NAME.fullmatch(text):
        raise InputError(f"{text!r} is not a host", hint="give a host name or an IP address, without a port")
    return x509.DNSName(text)


def _hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _texts(certificate: x509.Certificate, kind: x509.ObjectIdentifier) -> Sequence[str]:
    attributes: Iterable[Any] = certificate.subject.get_attributes_for_oid(kind)
    return [str(attribute.value) for attribute in attributes]


def _contents(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise IdentityError(path, f"can't read it: {error.strerror}") from None

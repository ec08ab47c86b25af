"""Certificates: a site's own, and those of its members, whose common name is the account's address.

A site's certificate signs all others. Keys are ECDSA P-256, which every TLS library supports. A member's certificate
also has its name (organization) and roles (organizational units), for people to read: only the roster gives rights.
Everything here is in memory; needs the extra `identity`.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from mesh.base.extras import needs_extra
from mesh.base.private_files import atomic_file, write_new
from mesh.errors import ConfigurationError, InputError, InvalidAddress
from mesh.ops.identity.roster import entry_of, roster_error, roster_from, roster_text
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from mesh.ops.identity.roster import Member

    Key: TypeAlias = "ec.EllipticCurvePrivateKey"


with needs_extra("identity", "a certificate"):
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

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


def identity_error(path: Path, why: str, *, hint: str = "") -> ConfigurationError:
    """The error of a certificate or a key that can't be used; `path` is its file."""
    hint = hint or "create certificates and keys with `aira identity new`"
    return ConfigurationError(f"{path}: {why}", hint=hint, code="identity-unusable")


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
    """Read a member's certificate, whose file is `path`. Raises `ConfigurationError` if it names no address."""
    names = _texts(certificate, NameOID.COMMON_NAME)
    try:
        address = parse_address(names[0] if names else "")
    except InvalidAddress:
        shown = repr(names[0]) if names else "empty"
        raise identity_error(path, f"the common name of the certificate is {shown}, not an address") from None
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
    """The address (lower case) of the holder of a member's certificate in a PEM file. Raises `ConfigurationError`."""
    path = Path(file).expanduser()
    return facts_of(read_certificate(path), path).holder.address


def read_certificate(path: Path) -> x509.Certificate:
    """Read the first certificate of a file. Raises `ConfigurationError`."""
    try:
        return x509.load_pem_x509_certificate(_contents(path))
    except ValueError:
        raise identity_error(path, "this is not a certificate (PEM)") from None


def read_key(path: Path) -> Key:
    """Read the key of a file. Raises `ConfigurationError`, which does not show the key."""
    try:
        key = serialization.load_pem_private_key(_contents(path), password=None)
    except (ValueError, TypeError):  # TypeError: it has a password
        raise identity_error(path, "this is not a private key (PEM, without password)") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise identity_error(path, "this is not an elliptic curve key")
    return key


def check_pair(certificate: x509.Certificate, key: Key, path: Path) -> None:
    """Raise `ConfigurationError` if the key in `path` is not the certificate's."""
    if certificate.public_key() != key.public_key():
        raise identity_error(path, "the key does not belong to the certificate")


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
        raise identity_error(path, f"can't read it: {error.strerror}") from None


@dataclass(frozen=True)
class SiteFolder:
    """The folder of a site's certificate and key. Anyone with the key can admit members."""

    path: Path

    @property
    def certificate(self) -> Path:
        """The certificate by which members verify each other."""
        return self.path / "ca.pem"

    @property
    def key(self) -> Path:
        """The key that signs members' certificates."""
        return self.path / "ca.key"

    def make(self, *, name: str, days: float) -> None:
        """Create the site. Raises `ConfigurationError` if it exists."""
        key = ec.generate_private_key(ec.SECP256R1())
        _prepare(self.path, self.certificate, self.key)
        _write(self.key, key)
        _write(self.certificate, site_certificate(key, name, days))


@dataclass(frozen=True)
class MemberFolder:
    """The folder of a member's certificate and key, and a copy of the site's certificate."""

    path: Path

    @property
    def certificate(self) -> Path:
        """The member's certificate: setting `tls_certificate`."""
        return self.path / "identity.pem"

    @property
    def key(self) -> Path:
        """Its key: setting `tls_key`."""
        return self.path / "identity.key"

    @property
    def ca(self) -> Path:
        """The site's certificate: setting `tls_ca`."""
        return self.path / "ca.pem"

    def make(self, holder: Holder, *, site: SiteFolder, days: float) -> CertificateFacts:
        """Create a key and a certificate for it, signed by the site. Raises `ConfigurationError`."""
        authority, site_key = _opened(site)
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = member_certificate(holder, key.public_key(), site=authority, site_key=site_key, days=days)
        _prepare(self.path, self.certificate, self.key, self.ca)
        _write(self.key, key)
        _write(self.ca, authority)
        _write(self.certificate, certificate)
        return facts_of(certificate, self.certificate)

    def renew(self, *, site: SiteFolder, days: float) -> CertificateFacts:
        """Create a new certificate for the same holder and key, valid from now on.

        An open session uses it the next time it connects.
        """
        authority, site_key = _opened(site)
        facts, public_key = self.facts(), read_certificate(self.certificate).public_key()
        if self.ca.exists() and read_certificate(self.ca) != authority:
            raise identity_error(self.ca, f"this identity does not belong to the site in {site.path}")
        certificate = member_certificate(facts.holder, public_key, site=authority, site_key=site_key, days=days)
        with atomic_file(self.certificate) as file:
            file.write(certificate.public_bytes(serialization.Encoding.PEM))
        return facts_of(certificate, self.certificate)

    def facts(self) -> CertificateFacts:
        """The content of the certificate. Raises `ConfigurationError` for missing, malformed or unmatched files."""
        certificate = read_certificate(self.certificate)
        if self.key.exists():
            check_pair(certificate, read_key(self.key), self.key)
        return facts_of(certificate, self.certificate)


def with_member(path: Path, member: Member) -> str:
    """The roster's text with one more member; the file need not exist. Raises `ConfigurationError`."""
    before = roster_text(path) if path.exists() else ""
    if before and not before.endswith("\n"):
        before += "\n"
    text = f"{before}\n{entry_of(member)}" if before else entry_of(member)
    roster_from(text, where=str(path))
    return text


def with_fingerprint(path: Path, address: str, *, old: str, new: str) -> str:
    """The roster's text with the fingerprint of a renewed certificate instead of the old one; unchanged if the member's
    entry has no fingerprint.

    Raises `ConfigurationError` if the member is missing or revoked, or its entry has another fingerprint.
    """
    before = roster_text(path)
    member = roster_from(before, where=str(path)).find(address)
    if member is None:
        raise roster_error(str(path), f"no member has the address {address}")
    where = f"{path}, member {member.name!r}"
    if member.revoked:
        raise roster_error(
            where, "it is revoked, so its certificate is not renewed", hint="delete the folder of its certificate"
        )
    if member.fingerprint not in ("", old):
        hint = "use the folder of the current certificate, or correct the fingerprint in the roster"
        raise roster_error(where, f"its certificate has another fingerprint than {old}", hint=hint)
    return re.sub(":?".join(re.findall("..", old)), new, before, flags=re.IGNORECASE)


def write_roster(path: Path, text: str) -> None:
    """Replace the roster file atomically. Raises `ConfigurationError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(text.encode())
            if path.exists():
                os.fchmod(file.fileno(), path.stat().st_mode & 0o777)
    except OSError as error:
        raise ConfigurationError(f"can't write the roster {path}: {error.strerror}") from None


def _opened(site: SiteFolder) -> tuple[Any, Any]:
    """The site's certificate and key. Raises `ConfigurationError`, also if the certificate has expired."""
    certificate, key = read_certificate(site.certificate), read_key(site.key)
    check_pair(certificate, key, site.key)
    if certificate.not_valid_after_utc <= datetime.now(UTC):
        raise identity_error(site.certificate, "the site's certificate has expired", hint="create a new site")
    return certificate, key


def _prepare(folder: Path, *files: Path) -> None:
    """Create the folder. Raises `ConfigurationError` if one of the files exists."""
    for file in files:
        if file.exists():
            raise ConfigurationError(
                f"{file} already exists", hint="files are never overwritten; choose another folder"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ConfigurationError(f"can't create the folder {folder}: {error.strerror}") from None


def _write(path: Path, content: x509.Certificate | Key) -> None:
    """Create a file with a certificate, or with a key that no other user can read; Zenoh supports no password for it.

    Raises `ConfigurationError`, also if the file exists.
    """
    pem = serialization.Encoding.PEM
    if isinstance(content, x509.Certificate):
        text, mode = content.public_bytes(pem), 0o644
    else:
        pkcs8, nothing = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        text, mode = content.private_bytes(pem, pkcs8, nothing), 0o600
    try:
        write_new(path, text, mode=mode)
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror}") from None

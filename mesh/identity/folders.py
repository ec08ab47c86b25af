"""Files of a site: its folder (`ca.pem`, `ca.key`), those of its members (`identity.pem`, `identity.key`, `ca.pem`),
and its roster.

Only their owner can read keys. Nothing is overwritten, except a certificate by its renewal and the roster by a change,
both atomically. The roster is edited as text, so that comments and order survive.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import ConfigurationError
from mesh.identity.certificates import (
    CertificateFacts,
    Holder,
    certificate_bytes,
    check_pair,
    facts_of,
    key_bytes,
    member_certificate,
    new_key,
    read_certificate,
    read_key,
    site_certificate,
)
from mesh.identity.errors import IdentityError, RosterError
from mesh.identity.roster import entry_of, roster_from

if TYPE_CHECKING:
    from pathlib import Path

    from mesh.identity.roster import Member

PRIVATE: Final = 0o600
PUBLIC: Final = 0o644


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
        key = new_key()
        _prepare(self.path, self.certificate, self.key)
        _write(self.key, key_bytes(key), PRIVATE)
        _write(self.certificate, certificate_bytes(site_certificate(key, name, days)), PUBLIC)


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
        key = new_key()
        certificate = member_certificate(holder, key.public_key(), site=authority, site_key=site_key, days=days)
        _prepare(self.path, self.certificate, self.key, self.ca)
        _write(self.key, key_bytes(key), PRIVATE)
        _write(self.ca, certificate_bytes(authority), PUBLIC)
        _write(self.certificate, certificate_bytes(certificate), PUBLIC)
        return facts_of(certificate, self.certificate)

    def renew(self, *, site: SiteFolder, days: float) -> CertificateFacts:
        """Create a new certificate for the same holder and key, valid from now on.

        An open session uses it the next time it connects.
        """
        authority, site_key = _opened(site)
        facts, public_key = self.facts(), read_certificate(self.certificate).public_key()
        if self.ca.exists() and read_certificate(self.ca) != authority:
            raise IdentityError(self.ca, f"this identity does not belong to the site in {site.path}")
        certificate = member_certificate(facts.holder, public_key, site=authority, site_key=site_key, days=days)
        fresh = self.certificate.with_suffix(".new")
        with suppress(FileNotFoundError):
            fresh.unlink()  # left by an interrupted renewal
        _write(fresh, certificate_bytes(certificate), PUBLIC)
        fresh.replace(self.certificate)
        return facts_of(certificate, self.certificate)

    def facts(self) -> CertificateFacts:
        """The content of the certificate. Raises `IdentityError` for missing, malformed or unmatched files."""
        certificate = read_certificate(self.certificate)
        if self.key.exists():
            check_pair(certificate, read_key(self.key), self.key)
        return facts_of(certificate, self.certificate)


def with_member(path: Path, member: Member) -> str:
    """The roster's text with one more member; the file need not exist. Raises `RosterError` if it can't be added."""
    before = _text(path) if path.exists() else ""
    if before and not before.endswith("\n"):
        before += "\n"
    text = f"{before}\n{entry_of(member)}" if before else entry_of(member)
    roster_from(text, where=str(path))
    return text


def with_fingerprint(path: Path, address: str, *, old: str, new: str) -> str:
    """The roster's text with the fingerprint of a renewed certificate instead of the old one; unchanged if the member's
    entry has no fingerprint.

    Raises `RosterError` if the member is missing or revoked, or its entry has another fingerprint.
    """
    before = _text(path)
    member = roster_from(before, where=str(path)).find(address)
    if member is None:
        raise RosterError(str(path), f"no member has the address {address}")
    where = f"{path}, member {member.name!r}"
    if member.revoked:
        raise RosterError(
            where,
            "it is revoked, so its certificate is not renewed",
            hint="delete the folder of its certificate",
        )
    if member.fingerprint not in ("", old):
        hint = "use the folder of the current certificate, or correct the fingerprint in the roster"
        raise RosterError(where, f"its certificate has another fingerprint than {old}", hint=hint)
    return re.sub(":?".join(re.findall("..", old)), new, before, flags=re.IGNORECASE)


def write_roster(path: Path, text: str) -> None:
    """Replace the roster file atomically. Raises `ConfigurationError`."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with fresh.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            fresh.chmod(path.stat().st_mode & 0o777)
        fresh.replace(path)
    except OSError as error:
        raise ConfigurationError(f"can't write the roster {path}: {error.strerror}") from None


def _opened(site: SiteFolder) -> tuple[Any, Any]:
    """The site's certificate and key. Raises `IdentityError`, also if the certificate has expired."""
    certificate, key = read_certificate(site.certificate), read_key(site.key)
    check_pair(certificate, key, site.key)
    if certificate.not_valid_after_utc <= datetime.now(UTC):
        raise IdentityError(site.certificate, "the site's certificate has expired", hint="create a new site")
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


def _write(path: Path, contents: bytes, mode: int) -> None:
    """Create a file with this mode. Raises `ConfigurationError`, also if it exists."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(contents)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror}") from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise RosterError(str(path), f"can't read it: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RosterError(str(path), "it is not UTF-8 text") from None

"""Folders of identities: a site's (`ca.pem`, `ca.key`) and a member's (`identity.pem`, `identity.key`, `ca.pem`).

Keys are readable by their owner only. Nothing is overwritten, but for a certificate by its renewal, in one step: who
reads it meanwhile finds the old one or the new one.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from mesh.errors import ConfigurationError
from mesh.identity.certificates import (
    Facts,
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
from mesh.identity.errors import IdentityError

if TYPE_CHECKING:
    from pathlib import Path

PRIVATE: Final = 0o600
PUBLIC: Final = 0o644


@dataclass(frozen=True)
class SiteFolder:
    """Where a site's certificate and key are. Whoever has the key can let in anybody."""

    path: Path

    @property
    def certificate(self) -> Path:
        """By which members know each other."""
        return self.path / "ca.pem"

    @property
    def key(self) -> Path:
        """The key that signs members' certificates."""
        return self.path / "ca.key"

    def make(self, *, name: str, days: float) -> None:
        """Make the site. Raises `ConfigurationError` where there is one already."""
        key = new_key()
        _prepare(self.path, self.certificate, self.key)
        _write(self.key, key_bytes(key), PRIVATE)
        _write(self.certificate, certificate_bytes(site_certificate(key, name, days)), PUBLIC)


@dataclass(frozen=True)
class MemberFolder:
    """Where a member's certificate and key are, and a copy of the site's certificate."""

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

    def make(self, holder: Holder, *, site: SiteFolder, days: float) -> Facts:
        """Make a key, and have the site sign a certificate for it. Raises `ConfigurationError`."""
        authority, site_key = _opened(site)
        key = new_key()
        certificate = member_certificate(holder, key.public_key(), site=authority, site_key=site_key, days=days)
        _prepare(self.path, self.certificate, self.key, self.ca)
        _write(self.key, key_bytes(key), PRIVATE)
        _write(self.ca, certificate_bytes(authority), PUBLIC)
        _write(self.certificate, certificate_bytes(certificate), PUBLIC)
        return facts_of(certificate, self.certificate)

    def renew(self, *, site: SiteFolder, days: float) -> Facts:
        """Have the site sign a new certificate for the same holder and key, valid from now on.

        A session that goes on takes it the next time that it connects.
        """
        authority, site_key = _opened(site)
        facts, public_key = self.facts(), read_certificate(self.certificate).public_key()
        if self.ca.exists() and read_certificate(self.ca) != authority:
            raise IdentityError(self.ca, f"this identity is not of the site in {site.path}")
        certificate = member_certificate(facts.holder, public_key, site=authority, site_key=site_key, days=days)
        fresh = self.certificate.with_suffix(".new")
        with suppress(FileNotFoundError):
            fresh.unlink()  # of a renewal that was broken off
        _write(fresh, certificate_bytes(certificate), PUBLIC)
        fresh.replace(self.certificate)
        return facts_of(certificate, self.certificate)

    def facts(self) -> Facts:
        """What the certificate says. Raises `IdentityError` for files that are missing, malformed or no pair."""
        certificate = read_certificate(self.certificate)
        if self.key.exists():
            check_pair(certificate, read_key(self.key), self.key)
        return facts_of(certificate, self.certificate)


def _opened(site: SiteFolder) -> tuple[Any, Any]:
    """The site's certificate and key, in force."""
    certificate, key = read_certificate(site.certificate), read_key(site.key)
    check_pair(certificate, key, site.key)
    if certificate.not_valid_after_utc <= datetime.now(UTC):
        raise IdentityError(site.certificate, "the site's certificate has expired", hint="make a new site")
    return certificate, key


def _prepare(folder: Path, *files: Path) -> None:
    """Make the folder; what is there already stays as it is."""
    for file in files:
        if file.exists():
            raise ConfigurationError(f"{file} exists already", hint="nothing is overwritten; choose another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ConfigurationError(f"can't make the folder {folder}: {error.strerror}") from None


def _write(path: Path, contents: bytes, mode: int) -> None:
    """Write a new file, which has its mode from the beginning. Raises `ConfigurationError`, also if it is there."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(contents)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror}") from None

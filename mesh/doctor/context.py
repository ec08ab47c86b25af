"""The context of the checks: the settings, the role, and what follows from them. Reads only the certificate's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from mesh.doctor.certificate import own_identity
from mesh.network.endpoints import TLS_PREFIXES
from mesh.settings import DEFAULTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.doctor.certificate import CertificateInfo
    from mesh.settings import Settings

Role: TypeAlias = Literal["agent", "provider", "validator", "person", "edge", "bridge", "router", "operator"]
Area: TypeAlias = Literal["network", "roster", "chain", "account", "spending", "stake", "judging", "disk"]

AREAS: Final[Mapping[Role, frozenset[Area]]] = {
    "agent": frozenset({"network", "chain", "account", "disk"}),
    "provider": frozenset({"network", "chain", "account", "stake", "disk"}),
    "validator": frozenset({"network", "chain", "account", "judging", "disk"}),
    "person": frozenset({"network", "chain", "account", "spending", "disk"}),
    "edge": frozenset({"network"}),
    "bridge": frozenset({"network", "chain", "disk"}),
    "router": frozenset({"roster", "network"}),
    "operator": frozenset({"network"}),
}
"""What each role needs."""


@dataclass(frozen=True, kw_only=True)
class SerialSettings:
    """The serial port of an edge agent, the protocol of its board (or `auto`), and bits per second (0: to be found)."""

    port: str = ""
    protocol: Literal["auto", "frames", "rosserial"] = "auto"
    baud: int = 0


@dataclass(frozen=True, kw_only=True)
class DoctorContext:
    """The machine to check.

    `requested_role` is the role given on the command line; `identity` is the content of the certificate; `agent` and
    `device` name the device of an edge agent; `chain_id` is the expected chain (EIP-155; 0: any).
    """

    settings: Settings
    requested_role: Role | None = None
    identity: CertificateInfo | None = None
    agent: str = ""
    device: str = ""
    serial: SerialSettings = SerialSettings()
    chain_id: int = 0

    @property
    def role(self) -> Role:
        """The requested role, or the one implied by the roster, the serial port or the certificate."""
        if self.requested_role is not None:
            return self.requested_role
        if self.settings.roster:
            return "router"
        if self.serial.port:
            return "edge"
        shown = next((role for role in AREAS if role in self.certificate_roles), None)
        return shown or ("operator" if "watcher" in self.certificate_roles else "agent")

    @property
    def certificate_roles(self) -> tuple[str, ...]:
        """The roles in the certificate."""
        return () if self.identity is None else self.identity.roles

    @property
    def areas(self) -> frozenset[Area]:
        """The areas that the role needs and this package checks."""
        areas = AREAS[self.role]
        if self.role == "bridge" and not (self.settings.web3_http_provider or self.settings.web3_ws_provider).strip():
            areas -= {"chain"}  # optional for a bridge
        return areas

    @property
    def roles(self) -> frozenset[Role]:
        """The roles whose registered checks run: the role itself, and those whose settings are given."""
        roles: set[Role] = {self.role}
        if self.settings.ipfs_http_provider != DEFAULTS.ipfs_http_provider:
            roles.add("bridge")
        if self.serial.port:
            roles.add("edge")
        return frozenset(roles)

    @property
    def connect(self) -> tuple[str, ...]:
        """The routers to check; for a router, itself and the routers that it links to."""
        settings = self.settings
        return (*settings.listen, *settings.link) if self.role == "router" else settings.connect

    @property
    def is_secure(self) -> bool:
        """Whether it connects to a site, where everyone presents a certificate."""
        return any(locator.startswith(TLS_PREFIXES) for locator in self.connect)

    @property
    def has_identity(self) -> bool:
        """Whether there is a certificate to check, or should be."""
        named = (self.settings.tls_ca, self.settings.tls_certificate, self.settings.tls_key)
        return self.is_secure or any(named)

    @property
    def keyfile(self) -> Path | None:
        """The account's keyfile, if the settings name one."""
        return Path(self.settings.keyfile).expanduser() if self.settings.keyfile else None

    def without_secrets(self, text: str) -> str:
        """The text without passwords and keys in the addresses of nodes and daemons."""
        settings = self.settings
        named = ",".join((settings.web3_http_provider, settings.web3_ws_provider, settings.ipfs_http_provider))
        for address in sorted({part.strip() for part in named.split(",")}, key=len, reverse=True):
            if address:
                text = text.replace(address, _redacted(address))
        return text


def _redacted(address: str) -> str:
    """A URL without user, password and path."""
    scheme, separator, rest = address.partition("://")
    if not separator:
        return address
    host, slash, path = rest.rpartition("@")[2].partition("/")
    return f"{scheme}://{host}{slash}{'…' if path else ''}"


def with_identity(context: DoctorContext) -> DoctorContext:
    """The context with the certificate's content: its roles and, for an edge agent, its device by default."""
    identity = own_identity(context.settings)
    if identity is None:
        return context
    context = replace(context, identity=identity)
    if context.role != "edge" or context.agent:
        return context
    return replace(context, agent=identity.address, device=identity.name)

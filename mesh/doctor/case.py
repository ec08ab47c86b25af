"""Who is examined: the settings, the role, and what follows from them. Pure but for the certificate's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from mesh.doctor.certificate import own_identity
from mesh.network.endpoints import TLS_PREFIXES
from mesh.settings import DEFAULTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.doctor.certificate import Shown
    from mesh.settings import Settings

Role: TypeAlias = Literal["agent", "provider", "person", "edge", "bridge", "router", "operator"]
Field: TypeAlias = Literal["network", "roster", "chain", "account", "spending", "stake", "ipfs", "disk", "serial"]

MATTERS: Final[Mapping[Role, frozenset[Field]]] = {
    "agent": frozenset({"network", "chain", "account", "disk"}),
    "provider": frozenset({"network", "chain", "account", "stake", "disk"}),
    "person": frozenset({"network", "chain", "account", "spending", "disk"}),
    "edge": frozenset({"network", "serial"}),
    "bridge": frozenset({"network", "chain", "ipfs", "disk"}),
    "router": frozenset({"roster", "network"}),
    "operator": frozenset({"network"}),
}
"""What each role can't do without."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """The serial line of an edge agent: its port, and what the firmware speaks at how many bits per second."""

    port: str = ""
    protocol: Literal["frames", "rosserial"] = "frames"
    baud: int = 57_600


@dataclass(frozen=True, kw_only=True)
class Case:
    """Who is examined.

    `asked_role` is the role that was named, if one was; `identity` is what its certificate says; `agent` and `device`
    are those that an edge agent serves; `chain_id` is the number of the chain that it should be (EIP-155; 0:
    any).
    """

    settings: Settings
    asked_role: Role | None = None
    identity: Shown | None = None
    agent: str = ""
    device: str = ""
    line: Line = Line()
    chain_id: int = 0

    @property
    def role(self) -> Role:
        """The role that was named, or the one that the settings are for: by the roster, the port, the certificate."""
        if self.asked_role is not None:
            return self.asked_role
        if self.settings.roster:
            return "router"
        if self.line.port:
            return "edge"
        shown = next((role for role in MATTERS if role in self.shown_roles), None)
        return shown or ("operator" if "watcher" in self.shown_roles else "agent")

    @property
    def shown_roles(self) -> tuple[str, ...]:
        """The roles in its certificate."""
        return () if self.identity is None else self.identity.roles

    @property
    def fields(self) -> frozenset[Field]:
        """What is looked at: what matters to the role, and what the settings name besides."""
        named: set[Field] = set()
        matters = MATTERS[self.role]
        if self.role == "bridge" and not (self.settings.web3_http_provider or self.settings.web3_ws_provider).strip():
            matters -= {"chain"}  # a bridge may do without
        if self.settings.ipfs_http_provider != DEFAULTS.ipfs_http_provider:
            named.add("ipfs")
        if self.line.port:
            named.add("serial")
        return matters | named

    @property
    def connect(self) -> tuple[str, ...]:
        """The routers that are looked at: for a router itself and those that it links to."""
        settings = self.settings
        return (*settings.listen, *settings.link) if self.role == "router" else settings.connect

    @property
    def is_secure(self) -> bool:
        """Whether it goes to a site, where everybody shows a certificate."""
        return any(locator.startswith(TLS_PREFIXES) for locator in self.connect)

    @property
    def has_identity(self) -> bool:
        """Whether there is anything of a certificate to be looked at, or should be."""
        named = (self.settings.tls_ca, self.settings.tls_certificate, self.settings.tls_key)
        return self.is_secure or any(named)

    @property
    def keyfile(self) -> Path | None:
        """The account's keyfile, if the settings name one."""
        return Path(self.settings.keyfile).expanduser() if self.settings.keyfile else None

    def without_secrets(self, text: str) -> str:
        """The same as it may be shown: addresses of nodes and daemons may hold a password, or a key in their path."""
        settings = self.settings
        named = ",".join((settings.web3_http_provider, settings.web3_ws_provider, settings.ipfs_http_provider))
        for address in sorted({part.strip() for part in named.split(",")}, key=len, reverse=True):
            if address:
                text = text.replace(address, _shown(address))
        return text


def _shown(address: str) -> str:
    """An address without what stands before an `@`, and without a path of a URL."""
    scheme, separator, rest = address.partition("://")
    if not separator:
        return address
    host, slash, path = rest.rpartition("@")[2].partition("/")
    return f"{scheme}://{host}{slash}{'…' if path else ''}"


def examined_as(case: Case) -> Case:
    """The same with what its certificate says: its roles and, of an edge agent, the device that it serves unless the
    roster names another."""
    identity = own_identity(case.settings)
    if identity is None:
        return case
    case = replace(case, identity=identity)
    if case.role != "edge" or case.agent:
        return case
    return replace(case, agent=identity.address, device=identity.name)

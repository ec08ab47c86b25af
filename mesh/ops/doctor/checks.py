"""Checks, their context (the settings, the role, and what follows from them) and their results. All checks run
concurrently, within one common time limit.
"""

from __future__ import annotations

import asyncio
import ssl
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias, TypeVar

from mesh.base.background import in_daemon_thread
from mesh.errors import AiraError, ConfigurationError, InvalidAddress
from mesh.network import Tls
from mesh.network.locators import TLS_PREFIXES
from mesh.network.tls import check_files
from mesh.settings import DEFAULTS
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, Sequence

    from mesh.settings import Settings


T = TypeVar("T")


class CheckStatus(Enum):
    """Whether something works."""

    OK = "ok"
    WARN = "warn"
    """It works now, but needs attention later or for some uses."""
    FAIL = "FAIL"


class CheckResult(NamedTuple):
    """What a check found: a stable `code` for programs, a line for people, and what to do (empty if it passed).

    The code is `ok` for a check that passed in the usual way, and an error's code for one that an error ended.
    """

    status: CheckStatus
    code: str
    message: str
    hint: str = ""

    @property
    def ok(self) -> bool:
        """Whether it works, with or without a warning."""
        return self.status is not CheckStatus.FAIL


def passed(message: str, *, code: str = "ok") -> CheckResult:
    """The check passed."""
    return CheckResult(CheckStatus.OK, code, message)


def warning(message: str, *, code: str, hint: str) -> CheckResult:
    """It works now, but needs attention."""
    return CheckResult(CheckStatus.WARN, code, message, hint)


def failed(message: str, *, code: str, hint: str) -> CheckResult:
    """The check failed."""
    return CheckResult(CheckStatus.FAIL, code, message, hint)


def from_error(error: AiraError) -> CheckResult:
    """An error as a failed check."""
    return failed(
        str(error),
        code=error.code,
        hint=error.hint or "see docs/guides/deploy.md; `aira settings` shows the effective settings",
    )


@dataclass(frozen=True, eq=False)
class Check:
    """Something to check: `run` returns the result; an `AiraError` that it raises is a failed check.

    It runs if at least one check of each group in `needs` has run and not failed. So a cause is reported once,
    not by every check that depends on it.
    """

    name: str
    run: Callable[[], Awaitable[CheckResult]]
    needs: tuple[tuple[Check, ...], ...] = ()


class CompletedCheck(NamedTuple):
    """A check and its result; None if it was skipped because of an earlier failure."""

    name: str
    result: CheckResult | None


async def run_checks(checks: Sequence[Check], *, seconds: float) -> AsyncGenerator[CompletedCheck]:
    """Run the checks and yield each in order, as soon as its result is known.

    A check without a result `seconds` after the start fails. A caller that does not read to the end must close the
    generator.
    """
    deadline = asyncio.get_running_loop().time() + seconds
    tasks: dict[Check, asyncio.Task[CheckResult | None]] = {}
    for check in checks:
        groups = [[tasks[needed] for needed in group] for group in check.needs]
        tasks[check] = asyncio.create_task(_run(check, groups, deadline=deadline, seconds=seconds), name=check.name)
    try:
        for check, task in tasks.items():
            yield CompletedCheck(check.name, await task)
    finally:
        for task in tasks.values():
            task.cancel()
        await asyncio.gather(*tasks.values(), return_exceptions=True)


async def in_thread(function: Callable[..., T], *arguments: Any) -> T:
    """Run a blocking function in a daemon thread: a dead name server or disk can hold a call for minutes."""
    name = getattr(function, "__name__", "check")
    return await asyncio.wrap_future(in_daemon_thread(partial(function, *arguments), name))


async def _run(
    check: Check, groups: list[list[asyncio.Task[CheckResult | None]]], *, deadline: float, seconds: float
) -> CheckResult | None:
    for group in groups:
        if not any(result is not None and result.ok for result in [await needed for needed in group]):
            return None
    try:
        async with asyncio.timeout_at(deadline) as limit:
            return await check.run()
    except AiraError as error:
        return from_error(error)
    except TimeoutError:
        if not limit.expired():
            raise
        return failed(
            f"no answer within {seconds:g} s", code="no-answer", hint="try a longer --timeout if it may be slow"
        )


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
    if (subject := check_files(tls, mode=mode)) is None:
        return None
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

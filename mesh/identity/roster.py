"""The roster: who belongs to a site. A TOML file, and the only place where that is said.

    lighthouses = ["airalab.lighthouse.3.robonomics.eth"]   # the site's markets; both generations' if not given

    [[member]]
    name = "arm-1"
    address = "0x…"           # the common name of the member's certificate
    roles = ["agent"]
    fingerprint = "…"         # of the certificate, SHA-256; for people and for `aira identity show`
    revoked = false

An edge agent (role `edge`) may name the `agent` (address) whose device it serves, and the `device`; otherwise they are
its own address and name.
"""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from mesh.errors import InvalidAddress, InvalidKey
from mesh.identity.errors import RosterError
from mesh.identity.roles import ROLES, Role
from schemas.address import parse_address
from schemas.key_chunks import lighthouse_chunk, name_chunk

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

MARKETS: Final = ("airalab.lighthouse.3.robonomics.eth", "airalab.lighthouse.5.robonomics.eth")
"""The lighthouses of a roster that names none."""
FINGERPRINT: Final = re.compile(r"[0-9a-f]{64}")

Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+$")]


class Member(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One who belongs to the site, or did: `address` and `agent` are in lower case, as in keys."""

    name: Name
    address: str
    roles: tuple[Role, ...]
    fingerprint: str = ""
    revoked: bool = False
    agent: str = ""
    device: str = ""


class Roster(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everybody, and the lighthouses (ENS names or addresses) whose markets the site's routers carry."""

    lighthouses: tuple[str, ...] = MARKETS
    member: tuple[Member, ...] = ()

    def admitted(self) -> tuple[Member, ...]:
        """The members who are not revoked."""
        return tuple(member for member in self.member if not member.revoked)

    def find(self, address: str) -> Member | None:
        """The member with this address (lower case), revoked or not."""
        return next((member for member in self.member if member.address == address), None)


def read_roster(path: Path) -> Roster:
    """The roster in a file. Raises `RosterError`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RosterError(
            str(path), f"it can't be read: {error.strerror}", hint="`aira identity new --roster FILE` begins one"
        ) from None
    except UnicodeDecodeError:
        raise RosterError(str(path), "it is not UTF-8 text") from None
    return roster_from(text, where=str(path))


def roster_from(text: str, *, where: str) -> Roster:
    """The roster that a TOML text holds, checked. Raises `RosterError`; `where` is what it calls the text."""
    try:
        roster = msgspec.convert(tomllib.loads(text), Roster)
    except tomllib.TOMLDecodeError as error:
        raise RosterError(where, f"it is not TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise _explained(where, str(error)) from None
    members = tuple(_checked(member, where) for member in roster.member)
    _check_unique(where, "address", (member.address for member in members))
    _check_unique(where, "name", (member.name for member in members))
    try:
        return Roster(lighthouses=tuple(map(lighthouse_chunk, roster.lighthouses)), member=members)
    except InvalidKey as error:
        raise RosterError(where, str(error)) from None


def entry_of(member: Member) -> str:
    """The lines of a roster for a member."""
    fields: dict[str, Any] = {"name": member.name, "address": member.address, "roles": list(member.roles)}
    fields |= {name: text for name in ("agent", "device", "fingerprint") if (text := getattr(member, name))}
    # A JSON text or list of plain texts is one of TOML, too.
    lines = (f"{name} = {msgspec.json.encode(value).decode()}" for name, value in fields.items())
    return "\n".join(("[[member]]", *lines, ""))


def _checked(member: Member, where: str) -> Member:
    """The same in canonical form."""
    where = f"{where}, member {member.name!r}"
    if not member.roles:
        raise RosterError(where, "it has no role", hint=f"roles are {', '.join(ROLES)}")
    fingerprint = member.fingerprint.replace(":", "").lower()
    if fingerprint and not FINGERPRINT.fullmatch(fingerprint):
        raise RosterError(where, "its fingerprint is not SHA-256: 64 hexadecimal digits")
    try:
        address = parse_address(member.address).lower()
        agent = parse_address(member.agent or address).lower() if "edge" in member.roles else ""
        device = name_chunk(member.device or member.name) if "edge" in member.roles else ""
    except (InvalidAddress, InvalidKey) as error:
        raise RosterError(where, str(error)) from None
    if "edge" not in member.roles and (member.agent or member.device):
        raise RosterError(where, "only one with the role edge serves a device of an agent")
    return msgspec.structs.replace(member, address=address, agent=agent, device=device, fingerprint=fingerprint)


def _check_unique(where: str, what: str, texts: Iterable[str]) -> None:
    seen: set[str] = set()
    for text in texts:
        if text in seen:
            raise RosterError(where, f"the {what} {text!r} is there twice")
        seen.add(text)


def _explained(where: str, error: str) -> RosterError:
    """msgspec's complaint, and where it is: `$.member[1].roles[0]`, counted from one."""
    why, _, path = error.partition(" - at `$.")
    place = re.sub(r"\[(\d+)\]", lambda found: f" {int(found[1]) + 1}", path.rstrip("`")).replace(".", ", ")
    hint = f"roles are {', '.join(ROLES)}" if "enum value" in why else ""
    why = why.replace("Invalid enum value", "there is no role").replace("Object contains unknown", "there is no")
    why = why.replace("Object missing required field", "it has no")
    return RosterError(f"{where}, {place}" if place else where, why, hint=hint)

"""The roster of a site, a TOML file: its members, their roles, and its markets.

    lighthouses = ["airalab.lighthouse.3.robonomics.eth"]   # the site's markets; default: those of both generations

    [[member]]
    name = "arm-1"
    address = "0x…"           # the common name of the member's certificate
    roles = ["agent"]
    fingerprint = "…"         # of the certificate, SHA-256; for people and for `aira identity show`
    revoked = false

An edge agent (role `edge`) may name the `agent` (address) whose device it serves, and the `device`; by default these
are its own address and name.

`ROLES` defines what each role may do; everything else is denied. Its keys are Zenoh key expressions with placeholders:
`{own}` is the member's address, `{agent}` and `{device}` those of an edge agent, `{market}` each lighthouse of the
site. A grant covers the keys and selectors that lie entirely within its own. `schemas.keys` defines the key
families. No role may delete on a market: its keys name no owner, so a storage there would lose other members'
orders.
"""

from __future__ import annotations

import re
import tomllib
from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta, Struct

from mesh.errors import InvalidAddress, InvalidKey
from mesh.identity.errors import RosterError
from schemas.address import parse_address
from schemas.agent_keys import name_chunk
from schemas.keys import lighthouse_chunk

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

MARKETS: Final = ("airalab.lighthouse.3.robonomics.eth", "airalab.lighthouse.5.robonomics.eth")
"""The default lighthouses of a roster."""
FINGERPRINT: Final = re.compile(r"[0-9a-f]{64}")

Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+$")]

Role: TypeAlias = Literal["agent", "person", "provider", "validator", "operator", "edge", "bridge", "watcher", "router"]


class Right(Enum):
    """An operation on keys."""

    PUT = "put"
    """Publish."""
    DELETE = "delete"
    """Delete what storages keep."""
    SERVE = "serve"
    """Declare a queryable, receive queries and reply to them."""
    TOKEN = "token"
    """Announce presence by a liveliness token."""
    GET = "get"
    """Query, and receive the replies."""
    SUBSCRIBE = "subscribe"
    """Receive what is published."""
    PRESENCE = "presence"
    """See the liveliness tokens of others."""


class Grant(NamedTuple):
    """Rights on keys."""

    rights: frozenset[Right]
    keys: tuple[str, ...]


def _grant(rights: str, *keys: str) -> Grant:
    return Grant(frozenset(Right(word) for word in rights.split()), keys)


def _orders(*kinds: str) -> Grant:
    """Publish messages of these kinds; their signatures identify the author."""
    return _grant("put", *(f"aira/{{market}}/{kind}{'/*' if kind in ('demand', 'offer') else ''}" for kind in kinds))


def _presence(*roles: str) -> Grant:
    return _grant("token", *(f"aira/{{market}}/@agent/{role}/{{own}}" for role in roles))


_OWN_SPACE: Final = _grant("put delete serve token get subscribe presence", "aira/agent/{own}/**")
_READ_MARKET: Final = (
    _grant("get subscribe", "aira/{market}/**"),
    _grant("presence", "aira/{market}/@agent/*/*"),
)
_READ_CONTENT: Final = _grant("get", "aira/agent/*/cid/*")
"""Who holds content serves it in its own space."""
_READINGS: Final = _grant("subscribe", "aira/agent/*/reading/**")

ROLES: Final[Mapping[Role, tuple[Grant, ...]]] = MappingProxyType(
    {
        "agent": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("offer", "withdrawal", "result"),
            _grant("put", "aira/{market}/decline/*"),
            _presence("agent"),
            _READ_CONTENT,
            _READINGS,
        ),
        # A person who orders work also runs an agent.
        "person": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("demand", "withdrawal"),
            _presence("agent", "person"),
            _READ_CONTENT,
            _READINGS,
        ),
        "provider": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("feedback", "pending"),
            _grant("put", "aira/{market}/reject/*"),
            # The provider serves its order book to late subscribers.
            _grant("serve", "aira/{market}/**"),
            _presence("provider"),
        ),
        "validator": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("result"),
            # It announces how it judges, and answers late parties with its reports.
            _grant("put serve", "aira/{market}/report/*"),
            _grant("serve", "aira/{market}/validator/*"),
            _presence("validator"),
            _READ_CONTENT,
        ),
        "operator": (
            _OWN_SPACE,
            *_READ_MARKET,
            _READ_CONTENT,
            _grant("get subscribe presence", "aira/agent/**"),
            _presence("operator"),
        ),
        "edge": (
            _grant("put serve token get subscribe presence", "aira/agent/{agent}/device/{device}/**"),
            _grant("put serve subscribe", "aira/agent/{agent}/liability/*/topic/**"),
            _grant("subscribe", "aira/agent/{agent}/liability/*/*", "aira/agent/{agent}/liability/*/objective/**"),
        ),
        # A bridge relays messages that are signed elsewhere. Its turn is a separate liveliness token.
        "bridge": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("demand", "offer", "withdrawal", "result", "feedback", "pending"),
            _presence("bridge", "bridge-turn-$*"),
            _READ_CONTENT,
        ),
        "watcher": (*_READ_MARKET, _READ_CONTENT, _grant("subscribe presence", "aira/agent/**")),
        # Another router of the site forwards what it has admitted itself.
        "router": (_grant(" ".join(right.value for right in Right), "aira/**", "aira/*/@agent/*/*"),),
    }
)
"""What each role may do."""


class Member(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A current or revoked member of the site. `address` and `agent` are in lower case, as in keys."""

    name: Name
    address: str
    roles: tuple[Role, ...]
    fingerprint: str = ""
    revoked: bool = False
    agent: str = ""
    device: str = ""


class Roster(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All members, and the lighthouses (ENS names or addresses) whose markets the site's routers carry."""

    lighthouses: tuple[str, ...] = MARKETS
    member: tuple[Member, ...] = ()

    def admitted(self) -> tuple[Member, ...]:
        """The members that are not revoked."""
        return tuple(member for member in self.member if not member.revoked)

    def find(self, address: str) -> Member | None:
        """The member with this address (lower case), revoked or not."""
        return next((member for member in self.member if member.address == address), None)


def read_roster(path: Path) -> Roster:
    """Read a roster file. Raises `RosterError`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RosterError(
            str(path), f"can't read it: {error.strerror}", hint="`aira identity new --roster FILE` creates one"
        ) from None
    except UnicodeDecodeError:
        raise RosterError(str(path), "it is not UTF-8 text") from None
    return roster_from(text, where=str(path))


def roster_from(text: str, *, where: str) -> Roster:
    """Parse and check a roster. Raises `RosterError`; `where` names the text in errors."""
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
    """The TOML of a member's entry."""
    fields: dict[str, Any] = {"name": member.name, "address": member.address, "roles": list(member.roles)}
    fields |= {name: text for name in ("agent", "device", "fingerprint") if (text := getattr(member, name))}
    # JSON strings and lists of strings are valid TOML.
    lines = (f"{name} = {msgspec.json.encode(value).decode()}" for name, value in fields.items())
    return "\n".join(("[[member]]", *lines, ""))


def _checked(member: Member, where: str) -> Member:
    """The member in canonical form. Raises `RosterError`."""
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
        raise RosterError(where, "only a member with the role edge serves a device of an agent")
    return msgspec.structs.replace(member, address=address, agent=agent, device=device, fingerprint=fingerprint)


def _check_unique(where: str, what: str, texts: Iterable[str]) -> None:
    seen: set[str] = set()
    for text in texts:
        if text in seen:
            raise RosterError(where, f"the {what} {text!r} occurs twice")
        seen.add(text)


def _explained(where: str, error: str) -> RosterError:
    """msgspec's error, with its place (`$.member[1].roles[0]`) counted from one."""
    why, _, path = error.partition(" - at `$.")
    place = re.sub(r"\[(\d+)\]", lambda found: f" {int(found[1]) + 1}", path.rstrip("`")).replace(".", ", ")
    hint = f"roles are {', '.join(ROLES)}" if "enum value" in why else ""
    why = why.replace("Invalid enum value", "there is no role").replace("Object contains unknown", "there is no")
    why = why.replace("Object missing required field", "it has no")
    return RosterError(f"{where}, {place}" if place else where, why, hint=hint)

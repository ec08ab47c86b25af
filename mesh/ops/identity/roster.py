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
site. A grant covers the keys and selectors that lie entirely within its own. `schemas.keys` defines the key families.
No role may delete on a market: its keys name no owner, so a storage there would lose other members' orders.

The rights of a member become Zenoh's `access_control` configuration. Zenoh 1.10: a message passes if the key expression
of one rule includes its own. `ingress` is what a member sends, `egress` what is sent to it. Zenoh identifies a member
by the first common name of its certificate.
"""

from __future__ import annotations

import re
from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta, Struct

from mesh.errors import ConfigurationError, InvalidAddress, InvalidKey
from schemas.address import parse_address
from schemas.decoding import InvalidData, decode_toml, text_of
from schemas.keys import KINDS, cid_selector, lighthouse_chunk, name_chunk

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path


def roster_error(where: str, why: str, *, hint: str = "") -> ConfigurationError:
    """The error of a roster that can't be used; `where` is the file and, if known, the entry."""
    return ConfigurationError(f"the roster {where}: {why}", hint=hint, code="roster-unusable")


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


def _messages(role: Role) -> Grant:
    """Publish the kinds of messages that a role makes, or relays. Their signatures identify the author."""
    kinds = [(name, kind) for name, kind in KINDS.items() if role in kind.put_by]
    return _grant("put", *(f"aira/{{market}}/{name}{'/*' if kind.subject else ''}" for name, kind in kinds))


def _presence(*roles: str) -> Grant:
    return _grant("token", *(f"aira/{{market}}/@agent/{role}/{{own}}" for role in roles))


_OWN_SPACE: Final = _grant("put delete serve token get subscribe presence", "aira/agent/{own}/**")
_READ_MARKET: Final = (_grant("get subscribe", "aira/{market}/**"), _grant("presence", "aira/{market}/@agent/*/*"))
_READ_CONTENT: Final = _grant("get", "aira/agent/*/cid/*")
"""Who holds content serves it in its own space."""
_READINGS: Final = _grant("subscribe", "aira/agent/*/reading/**")
_PROFILES: Final = _grant("get subscribe", "aira/agent/*/profile")
_ORDERS: Final = _grant(
    "get", *(f"aira/agent/*/rpc/{service}" for service in ("quote", "accept", "permit-fee", "pair", "stop"))
)
"""What those who order ask of robots and providers; where it matters who asks, a signature says so."""

ROLES: Final[Mapping[Role, tuple[Grant, ...]]] = MappingProxyType(
    {
        "agent": (
            _OWN_SPACE,
            *_READ_MARKET,
            _messages("agent"),
            _presence("agent"),
            _READ_CONTENT,
            _READINGS,
            _PROFILES,
            _ORDERS,
        ),
        # A person who orders work also runs an agent.
        "person": (
            _OWN_SPACE,
            *_READ_MARKET,
            _messages("person"),
            _presence("agent", "person"),
            _READ_CONTENT,
            _READINGS,
            _PROFILES,
            _ORDERS,
        ),
        "provider": (
            _OWN_SPACE,
            *_READ_MARKET,
            _messages("provider"),
            # The provider serves its order book to late subscribers.
            _grant("serve", "aira/{market}/**"),
            _presence("provider"),
        ),
        "validator": (
            _OWN_SPACE,
            *_READ_MARKET,
            _messages("validator"),
            # It announces how it judges, and answers late parties with its reports.
            _grant("serve", "aira/{market}/report/*", "aira/{market}/validator/*"),
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
            _grant("get", "aira/agent/{agent}/liability/*/*"),
            _grant("subscribe", "aira/agent/{agent}/liability/*/*", "aira/agent/{agent}/liability/*/objective/**"),
        ),
        # A bridge relays messages that are signed elsewhere. Its turn is a separate liveliness token.
        "bridge": (
            _OWN_SPACE,
            *_READ_MARKET,
            _messages("bridge"),
            _presence("bridge", "bridge-turn-$*"),
            _READ_CONTENT,
        ),
        "watcher": (*_READ_MARKET, _READ_CONTENT, _PROFILES, _grant("subscribe presence", "aira/agent/**")),
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
    """Read a roster file. Raises `ConfigurationError`."""
    return roster_from(roster_text(path), where=str(path))


def roster_text(path: Path) -> str:
    """The text of a roster file. Raises `ConfigurationError`."""
    try:
        return text_of(path.read_bytes())
    except OSError as error:
        raise roster_error(
            str(path), f"can't read it: {error.strerror}", hint="`aira identity new --roster FILE` creates one"
        ) from None
    except InvalidData as error:
        raise roster_error(str(path), str(error), hint=error.hint) from None


def roster_from(text: str, *, where: str) -> Roster:
    """Parse and check a roster. Raises `ConfigurationError`; `where` names the text in errors."""
    try:
        roster = msgspec.convert(decode_toml(text), Roster)
    except InvalidData as error:
        raise roster_error(where, f"it is not TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise _explained(where, str(error)) from None
    members = tuple(_checked(member, where) for member in roster.member)
    _check_unique(where, "address", (member.address for member in members))
    _check_unique(where, "name", (member.name for member in members))
    try:
        return Roster(lighthouses=tuple(map(lighthouse_chunk, roster.lighthouses)), member=members)
    except InvalidKey as error:
        raise roster_error(where, str(error)) from None


def entry_of(member: Member) -> str:
    """The TOML of a member's entry."""
    fields: dict[str, Any] = {"name": member.name, "address": member.address, "roles": list(member.roles)}
    fields |= {name: text for name in ("agent", "device", "fingerprint") if (text := getattr(member, name))}
    # JSON strings and lists of strings are valid TOML.
    lines = (f"{name} = {msgspec.json.encode(value).decode()}" for name, value in fields.items())
    return "\n".join(("[[member]]", *lines, ""))


def _checked(member: Member, where: str) -> Member:
    """The member in canonical form. Raises `ConfigurationError`."""
    where = f"{where}, member {member.name!r}"
    if not member.roles:
        raise roster_error(where, "it has no role", hint=f"roles are {', '.join(ROLES)}")
    fingerprint = member.fingerprint.replace(":", "").lower()
    if fingerprint and not FINGERPRINT.fullmatch(fingerprint):
        raise roster_error(where, "its fingerprint is not SHA-256: 64 hexadecimal digits")
    try:
        address = parse_address(member.address).lower()
        agent = parse_address(member.agent or address).lower() if "edge" in member.roles else ""
        device = name_chunk(member.device or member.name) if "edge" in member.roles else ""
    except (InvalidAddress, InvalidKey) as error:
        raise roster_error(where, str(error)) from None
    if "edge" not in member.roles and (member.agent or member.device):
        raise roster_error(where, "only a member with the role edge serves a device of an agent")
    return msgspec.structs.replace(member, address=address, agent=agent, device=device, fingerprint=fingerprint)


def _check_unique(where: str, what: str, texts: Iterable[str]) -> None:
    seen: set[str] = set()
    for text in texts:
        if text in seen:
            raise roster_error(where, f"the {what} {text!r} occurs twice")
        seen.add(text)


def _explained(where: str, error: str) -> ConfigurationError:
    """msgspec's error, with its place (`$.member[1].roles[0]`) counted from one."""
    why, _, path = error.partition(" - at `$.")
    place = re.sub(r"\[(\d+)\]", lambda found: f" {int(found[1]) + 1}", path.rstrip("`")).replace(".", ", ")
    hint = f"roles are {', '.join(ROLES)}" if "enum value" in why else ""
    why = why.replace("Invalid enum value", "there is no role").replace("Object contains unknown", "there is no")
    why = why.replace("Object missing required field", "it has no")
    return roster_error(f"{where}, {place}" if place else where, why, hint=hint)


INGRESS: Final[Mapping[Right, tuple[str, ...]]] = MappingProxyType(
    {
        Right.PUT: ("put",),
        Right.DELETE: ("delete",),
        Right.SERVE: ("declare_queryable", "reply"),
        Right.TOKEN: ("liveliness_token",),
        Right.GET: ("query",),
        Right.SUBSCRIBE: ("declare_subscriber",),
        Right.PRESENCE: ("liveliness_query", "declare_liveliness_subscriber"),
    }
)
"""What a member with this right sends."""
EGRESS: Final[Mapping[Right, tuple[str, ...]]] = MappingProxyType(
    {
        Right.SERVE: ("query",),
        Right.GET: ("reply",),
        Right.SUBSCRIBE: ("put", "delete"),
        Right.PRESENCE: ("liveliness_token",),
    }
)
"""What is sent to a member with this right."""
DECLARED: Final = {
    "id": "what is declared",
    "permission": "allow",
    "flows": ["egress"],
    # A publisher sends nothing until it learns of a subscriber, whose selector may be wider than its key.
    "messages": ["declare_subscriber", "declare_queryable"],
    "key_exprs": ["aira/**"],
}

ASKED: Final = {
    "id": "queries to every store",
    "permission": "allow",
    "flows": ["egress"],
    # These name no agent, so no member's own space includes them. They reach those that serve content there.
    "messages": ["query"],
    "key_exprs": [cid_selector()],
}
SHARED: Final = (DECLARED, ASKED)
"""The rules that apply to every member."""


class Permission(NamedTuple):
    """A right of a member on these key expressions and everything that they cover."""

    member: Member
    right: Right
    keys: tuple[str, ...]


def access_of(roster: Roster) -> Iterator[Permission]:
    """All permissions, in the order of the roster. Everything else is denied; revoked members have none."""
    for member in roster.admitted():
        grants = [grant for role in member.roles for grant in ROLES[role]]
        named = {"own": member.address, "agent": member.agent, "device": member.device}
        for right in Right:
            shapes = dict.fromkeys(key for grant in grants if right in grant.rights for key in grant.keys)
            keys = tuple(
                dict.fromkeys(
                    shape.format(market=market, **named)
                    for shape in shapes
                    for market in (roster.lighthouses if "{market}" in shape else ("",))
                )
            )
            if keys:
                yield Permission(member, right, keys)


def access_control(roster: Roster) -> dict[str, Any]:
    """Zenoh's `access_control` for a site's routers: it denies what the roster does not allow."""
    rules: list[dict[str, Any]] = [*SHARED]
    for member, right, keys in access_of(roster):
        for flow, messages in (("ingress", INGRESS.get(right, ())), ("egress", EGRESS.get(right, ()))):
            if messages:
                rules.append(
                    {
                        "id": f"{member.address} {right.value} {flow}",
                        "permission": "allow",
                        "flows": [flow],
                        "messages": list(messages),
                        "key_exprs": list(keys),
                    }
                )
    subjects, policies = [], []
    for address in (member.address for member in roster.admitted()):
        # In lower case and in EIP-55: other tools may have created the certificates.
        subjects.append({"id": address, "cert_common_names": [address, parse_address(address)]})
        own = [rule["id"] for rule in rules if rule in SHARED or rule["id"].startswith(address)]
        policies.append({"subjects": [address], "rules": own})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}

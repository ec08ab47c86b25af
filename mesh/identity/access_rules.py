"""The rights of each member by the roster, and Zenoh's `access_control` configuration for them. Pure.

Zenoh 1.10: a message passes if the key expression of one rule includes its own. `ingress` is what a member sends,
`egress` what is sent to it. Zenoh identifies a member by the first common name of its certificate.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mesh.identity.roster import ROLES, Right
from schemas.address import parse_address
from schemas.selectors import cid_selector

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from mesh.identity.roster import Member, Roster

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


def access_of(roster: Roster) -> tuple[Permission, ...]:
    """All permissions, in the order of the roster. Everything else is denied; revoked members have none."""
    return tuple(permission for member in roster.admitted() for permission in _of_member(roster, member))


def _of_member(roster: Roster, member: Member) -> Iterator[Permission]:
    grants = [grant for role in member.roles for grant in ROLES[role]]
    for right in Right:
        shapes = dict.fromkeys(key for grant in grants if right in grant.rights for key in grant.keys)
        keys = tuple(dict.fromkeys(key for shape in shapes for key in _filled(shape, roster, member)))
        if keys:
            yield Permission(member, right, keys)


def _filled(shape: str, roster: Roster, member: Member) -> Iterator[str]:
    """The key expressions of a grant for this member: one, or one per market."""
    for market in roster.lighthouses if "{market}" in shape else ("",):
        yield shape.format(own=member.address, agent=member.agent, device=member.device, market=market)


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
    members = roster.admitted()
    # In lower case and in EIP-55: other tools may have created the certificates.
    subjects = [
        {"id": member.address, "cert_common_names": [member.address, parse_address(member.address)]}
        for member in members
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": [
            {"subjects": [address], "rules": _rules_of(address, rules)}
            for address in (member.address for member in members)
        ],
    }


def _rules_of(address: str, rules: list[dict[str, Any]]) -> list[str]:
    return [rule["id"] for rule in rules if rule in SHARED or rule["id"].startswith(address)]

"""Who may do what, in the words of Zenoh's configuration. Pure.

Source: Zenoh 1.10, `access_control`. A message passes if one rule's key expression includes its own; what comes from a
member is `ingress`, what goes to him `egress`. Zenoh knows a member by the first common name of his certificate.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from mesh.identity.access import access_of
from mesh.identity.roles import Right
from schemas.address import parse_address

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mesh.identity.roster import Roster

FROM: Final[Mapping[Right, tuple[str, ...]]] = MappingProxyType(
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
"""What a member with the right sends."""
TO: Final[Mapping[Right, tuple[str, ...]]] = MappingProxyType(
    {
        Right.SERVE: ("query",),
        Right.GET: ("reply",),
        Right.SUBSCRIBE: ("put", "delete"),
        Right.PRESENCE: ("liveliness_token",),
    }
)
"""What is sent to a member with the right."""
DECLARED: Final = {
    "id": "what is declared",
    "permission": "allow",
    "flows": ["egress"],
    # A declared publisher sends nothing unless it is told who subscribes, to whatever wider selector that may be.
    "messages": ["declare_subscriber", "declare_queryable"],
    "key_exprs": ["aira/**"],
}


def access_control(roster: Roster) -> dict[str, Any]:
    """Zenoh's `access_control` for a site's routers: what the roster does not allow is denied."""
    rules: list[dict[str, Any]] = [DECLARED]
    for member, right, keys in access_of(roster):
        for flow, messages in (("ingress", FROM.get(right, ())), ("egress", TO.get(right, ()))):
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
    # As in keys, and as EIP-55 writes it: certificates may have been made by other means.
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
    return [rule["id"] for rule in rules if rule is DECLARED or rule["id"].startswith(address)]

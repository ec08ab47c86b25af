"""Who may do what, by the roster. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from mesh.identity.roles import ROLES, Right

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mesh.identity.roster import Member, Roster


class Permission(NamedTuple):
    """A member may do this with these key expressions and with all that they cover."""

    member: Member
    right: Right
    keys: tuple[str, ...]


def access_of(roster: Roster) -> tuple[Permission, ...]:
    """All that is allowed, in the order of the roster; what is not named is not, and nothing is to the revoked."""
    return tuple(permission for member in roster.admitted() for permission in _of_member(roster, member))


def _of_member(roster: Roster, member: Member) -> Iterator[Permission]:
    grants = [grant for role in member.roles for grant in ROLES[role]]
    for right in Right:
        shapes = dict.fromkeys(key for grant in grants if right in grant.rights for key in grant.keys)
        keys = tuple(dict.fromkeys(key for shape in shapes for key in _filled(shape, roster, member)))
        if keys:
            yield Permission(member, right, keys)


def _filled(shape: str, roster: Roster, member: Member) -> Iterator[str]:
    """The key expressions of a grant for this member: one, or one for each market."""
    for market in roster.lighthouses if "{market}" in shape else ("",):
        yield shape.format(own=member.address, agent=member.agent, device=member.device, market=market)

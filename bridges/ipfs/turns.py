"""Whose turn it is when several bridges stand between the same two channels. Pure.

Each bridge shows a turn for as long as it can carry messages. The best turn carries; the others keep what they heard
until they see it on the far side. A bridge whose daemon has nobody to talk to stands behind one whose has; among equals
the one that has been there longer goes first, so that who joins takes nothing out of another's hands.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas import InvalidKey, PresenceKey, parse_key

if TYPE_CHECKING:
    from collections.abc import Iterable

ROLE: Final = "bridge"
"""The role under which a bridge shows that it is there, whatever it can do just now."""
_TURN: Final = re.compile(r"bridge-turn-([01])-([0-9a-f]{16})")


class Turn(NamedTuple):
    """A place in the order, the lowest first. `since` is in nanoseconds of the clock; `bridge` is its address."""

    deaf: bool
    since: int
    bridge: str

    def key(self, lighthouse: str) -> str:
        """The liveliness token that shows it."""
        return str(PresenceKey(lighthouse, f"bridge-turn-{int(self.deaf)}-{self.since:016x}", self.bridge))


def turn_of(key: str) -> Turn | None:
    """The turn that a liveliness token shows, if it shows one."""
    try:
        presence = parse_key(key)
    except InvalidKey:
        return None
    if not isinstance(presence, PresenceKey):
        return None
    found = _TURN.fullmatch(presence.role)
    return Turn(found[1] == "1", int(found[2], 16), presence.agent) if found else None


def first_before(own: Turn | None, others: Iterable[Turn]) -> Turn | None:
    """Who carries instead of the bridge with the turn `own`: the best of the others, if it is better."""
    best = min(others, default=None)
    return best if best is not None and (own is None or best < own) else None

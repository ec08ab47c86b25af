"""What each role may do on a site's routers. Pure; everything that is not granted here is refused.

Keys are Zenoh key expressions with places to fill: `{own}` is the member's address, `{agent}` and `{device}` those of
the device that an edge agent serves, `{market}` is each of the site's lighthouses in turn. A grant covers the keys and
selectors that lie wholly within its own. The families of keys are those of `schemas.keys`.

Nobody may delete on a market: its keys name no owner, and a storage there would lose another's orders.
"""

from __future__ import annotations

from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

Role: TypeAlias = Literal["agent", "person", "provider", "operator", "edge", "bridge", "watcher", "router"]


class Right(Enum):
    """Something that may be done with keys."""

    PUT = "put"
    """Publish."""
    DELETE = "delete"
    """Take back what storages hold."""
    SERVE = "serve"
    """Declare a queryable, hear queries there and reply to them."""
    TOKEN = "token"
    """Show presence by a liveliness token."""
    GET = "get"
    """Query, and hear the replies."""
    SUBSCRIBE = "subscribe"
    """Hear what is published."""
    PRESENCE = "presence"
    """See the liveliness tokens of others."""


class Grant(NamedTuple):
    """Rights on keys."""

    rights: frozenset[Right]
    keys: tuple[str, ...]


def _grant(rights: str, *keys: str) -> Grant:
    return Grant(frozenset(Right(word) for word in rights.split()), keys)


def _orders(*kinds: str) -> Grant:
    """Publishing messages of these kinds; their signatures say whose they are."""
    shapes = {"demand": "*/*", "offer": "*/*", "result": "*/*", "feedback": "*/*", "pending": "*"}
    return _grant("put", *(f"aira/{{market}}/{kind}/{shapes[kind]}" for kind in kinds))


def _shown_as(*roles: str) -> Grant:
    return _grant("token", *(f"aira/{{market}}/@agent/{role}/{{own}}" for role in roles))


_OWN_SPACE: Final = _grant("put delete serve token get subscribe presence", "aira/agent/{own}/**")
_READ_MARKET: Final = (
    _grant("get subscribe", "aira/{market}/**"),
    _grant("presence", "aira/{market}/@agent/*/*"),
)
_READ_CONTENT: Final = _grant("get", "aira/cid/*")
_HOLD_CONTENT: Final = _grant("get serve", "aira/cid/*")

ROLES: Final[Mapping[Role, tuple[Grant, ...]]] = MappingProxyType(
    {
        "agent": (_OWN_SPACE, *_READ_MARKET, _orders("offer", "result"), _shown_as("agent"), _HOLD_CONTENT),
        # A person who asks for work runs an agent, too.
        "person": (_OWN_SPACE, *_READ_MARKET, _orders("demand"), _shown_as("agent", "person"), _HOLD_CONTENT),
        "provider": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("feedback", "pending"),
            _grant("put", "aira/{market}/reject/*/{own}"),
            # The order book is the market's memory.
            _grant("serve", "aira/{market}/**"),
            _shown_as("provider"),
        ),
        "operator": (
            _OWN_SPACE,
            *_READ_MARKET,
            _READ_CONTENT,
            _grant("get subscribe presence", "aira/agent/**"),
            _shown_as("operator"),
        ),
        "edge": (
            _grant("put serve token get subscribe presence", "aira/agent/{agent}/device/{device}/**"),
            _grant("put serve subscribe", "aira/agent/{agent}/liability/*/topic/**"),
            _grant("subscribe", "aira/agent/{agent}/liability/*/*", "aira/agent/{agent}/liability/*/objective/**"),
        ),
        # What comes from elsewhere is signed there; a bridge only carries it. Its turn is a token of its own.
        "bridge": (
            _OWN_SPACE,
            *_READ_MARKET,
            _orders("demand", "offer", "result", "feedback", "pending"),
            _shown_as("bridge", "bridge-turn-$*"),
            _HOLD_CONTENT,
        ),
        "watcher": (*_READ_MARKET, _READ_CONTENT, _grant("subscribe presence", "aira/agent/**")),
        # Another router of the site passes on what it has let in itself.
        "router": (_grant(" ".join(right.value for right in Right), "aira/**", "aira/*/@agent/*/*"),),
    }
)
"""What each role is for."""

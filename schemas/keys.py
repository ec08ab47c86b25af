"""The keyspace: all keys and their meaning. Those of agents are in `schemas.agent_keys`.

`str(key)` is the text of a key, `parse_key` parses one; both make the same checks, because Zenoh itself accepts blanks,
line ends and NUL in a key. Each key has exactly one text. `schemas.selectors` has the selectors for subscribers and
queries.

A lighthouse is given by its ENS name in lower case, or by its address if it has none. Addresses are in lower case (the
classes accept any case). A topic is written as in ROS, `/a/b`, and becomes the chunks `a/b`. To add a family of keys,
add its class, its pattern in `_parse`, and a selector.

A market's keys name only what subscribers select by: the model of an order, the maker of what is rejected or declined.
Hashes are not in them. A router looks up a key that somebody subscribed to, but compares a new one with all its
siblings, so the cost of a message would grow with the number of models.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Final, Literal, TypeAlias, get_args

from schemas.address import parse_address_or_name
from schemas.agent_keys import (
    AGENT_KEYS,
    CACHED,
    AgentKey,
    BaseKey,
    KeyParser,
    address_chunk,
    cid_chunk,
    name_chunk,
)
from schemas.errors import InvalidAddress, InvalidKey

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MarketKind: TypeAlias = Literal[
    "demand", "offer", "withdrawal", "result", "feedback", "pending", "reject", "decline", "report"
]


@lru_cache(maxsize=CACHED)
def lighthouse_chunk(text: str) -> str:
    """A lighthouse: its ENS name, or its address if it has none; in lower case."""
    try:
        return parse_address_or_name(text).lower()
    except InvalidAddress:
        raise InvalidKey(text, "a lighthouse is named by an ENS name or an address") from None


class _Key(BaseKey, frozen=True, gc=False):
    """The base of the keys that are not an agent's."""

    checks: ClassVar[Mapping[str, Callable[[str], str]]] = {
        "lighthouse": lighthouse_chunk,
        "agent": address_chunk,
        "maker": address_chunk,
        "validator": address_chunk,
        "model": cid_chunk,
        "role": name_chunk,
    }


class DemandKey(_Key, frozen=True):
    """The Demands for `model`; put by promisees."""

    pattern: ClassVar = "aira/{lighthouse}/demand/{model}"
    lighthouse: str
    model: str


class OfferKey(_Key, frozen=True):
    """The Offers of `model`; put by promisors."""

    pattern: ClassVar = "aira/{lighthouse}/offer/{model}"
    lighthouse: str
    model: str


class WithdrawalKey(_Key, frozen=True):
    """The Withdrawals of orders; put by the orders' makers."""

    pattern: ClassVar = "aira/{lighthouse}/withdrawal"
    lighthouse: str


class ResultKey(_Key, frozen=True):
    """The Results of liabilities; put by promisors."""

    pattern: ClassVar = "aira/{lighthouse}/result"
    lighthouse: str


class FeedbackKey(_Key, frozen=True):
    """The feedback of generation-5 providers on orders."""

    pattern: ClassVar = "aira/{lighthouse}/feedback"
    lighthouse: str


class PendingKey(_Key, frozen=True):
    """The notes of generation-5 providers of the transactions that they have sent."""

    pattern: ClassVar = "aira/{lighthouse}/pending"
    lighthouse: str


class RejectKey(_Key, frozen=True):
    """The providers' rejections of orders and results that `maker` has signed."""

    pattern: ClassVar = "aira/{lighthouse}/reject/{maker}"
    lighthouse: str
    maker: str


class DeclineKey(_Key, frozen=True):
    """The agents' declines of demands that `maker` has signed."""

    pattern: ClassVar = "aira/{lighthouse}/decline/{maker}"
    lighthouse: str
    maker: str


class ReportKey(_Key, frozen=True):
    """The validators' reports on results of liabilities of which `maker` is a party; put by validators.

    A query for `…?liability=ADDRESS` asks them for earlier reports.
    """

    pattern: ClassVar = "aira/{lighthouse}/report/{maker}"
    lighthouse: str
    maker: str


class ValidatorKey(_Key, frozen=True):
    """The announcements of `validator`, one of each of its jurors; validators answer queries of it."""

    pattern: ClassVar = "aira/{lighthouse}/validator/{validator}"
    lighthouse: str
    validator: str


class PresenceKey(_Key, frozen=True):
    """The liveliness token of `agent` in its role (`provider`, `agent`, `edge`, …); no wildcard matches `@agent`."""

    pattern: ClassVar = "aira/{lighthouse}/@agent/{role}/{agent}"
    lighthouse: str
    role: str
    agent: str


MarketKey: TypeAlias = (
    DemandKey | OfferKey | WithdrawalKey | ResultKey | FeedbackKey | PendingKey | RejectKey | DeclineKey | ReportKey
)
Key: TypeAlias = MarketKey | AgentKey | ValidatorKey | PresenceKey


def market_key(lighthouse: str, kind: MarketKind, model: str) -> str:
    """The key of a message whose parts are canonical already, without the checks. `model` is empty but for orders."""
    return f"aira/{lighthouse}/{kind}/{model}" if model else f"aira/{lighthouse}/{kind}"


def market_kind(text: str) -> str:
    """The kind that a key on a lighthouse names; any text, because this checks nothing."""
    return text.split("/", 3)[2] if text.count("/") > 1 else ""


parse_key: Final = KeyParser[Key](*get_args(MarketKey), ValidatorKey, PresenceKey, *AGENT_KEYS).parse
"""The key with a text. Raises `InvalidKey` if there is none, or if it is not in the canonical form."""

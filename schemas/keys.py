"""The keyspace: all keys and their meaning. Those of agents are in `schemas.agent_keys`.

`str(key)` is the text of a key, `parse_key` parses one; both make the same checks, because Zenoh itself accepts blanks,
line ends and NUL in a key. Each key has exactly one text. `schemas.selectors` has the selectors for subscribers and
queries.

A lighthouse is given by its ENS name in lower case, or by its address if it has none. Addresses are in lower case (the
classes accept any case), hashes are 64 hexadecimal digits in lower case without `0x`. A topic is written as in ROS,
`/a/b`, and becomes the chunks `a/b`. To add a family of keys, add its class, its pattern in `_parse`, and a selector.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

from schemas.address import parse_address_or_name
from schemas.agent_keys import (
    CACHED,
    AgentKey,
    BaseKey,
    address_chunk,
    check_canonical,
    check_length,
    name_chunk,
    parse_agent_key,
)
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidKey

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MarketKind: TypeAlias = Literal["demand", "offer", "withdrawal", "result", "feedback", "pending", "reject"]


@lru_cache(maxsize=CACHED)
def lighthouse_chunk(text: str) -> str:
    """A lighthouse: its ENS name, or its address if it has none; in lower case."""
    try:
        return parse_address_or_name(text).lower()
    except InvalidAddress:
        raise InvalidKey(text, "a lighthouse is named by an ENS name or an address") from None


def cid_chunk(text: str) -> str:
    """A CIDv0."""
    try:
        parse_cid(text)
    except InvalidCid as error:
        raise InvalidKey(text, str(error)) from None
    return text


def hash_chunk(text: str) -> str:
    """A 32-byte hash: 64 hexadecimal digits in lower case, without `0x`."""
    try:
        # This also rejects upper case and the blanks that bytes.fromhex() skips.
        if len(text) == 64 and bytes.fromhex(text).hex() == text:
            return text
    except ValueError:
        pass
    raise InvalidKey(text, "a hash is 64 hexadecimal digits in lower case, without 0x")


class _Key(BaseKey, frozen=True, gc=False):
    """The base of the keys that are not an agent's."""

    checks: ClassVar[Mapping[str, Callable[[str], str]]] = {
        "lighthouse": lighthouse_chunk,
        "agent": address_chunk,
        "liability": address_chunk,
        "provider": address_chunk,
        "model": cid_chunk,
        "cid": cid_chunk,
        "hash": hash_chunk,
        "order": hash_chunk,
        "tx": hash_chunk,
        "role": name_chunk,
    }


class DemandKey(_Key, frozen=True):
    """A Demand for `model` with this message hash; put by the promisee."""

    lighthouse: str
    model: str
    hash: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/demand/{self.model}/{self.hash}"


class OfferKey(_Key, frozen=True):
    """An Offer of `model` with this message hash; put by the promisor."""

    lighthouse: str
    model: str
    hash: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/offer/{self.model}/{self.hash}"


class WithdrawalKey(_Key, frozen=True):
    """A Withdrawal of the order with the hash `order`; `hash` is its own. Put by the order's maker."""

    lighthouse: str
    order: str
    hash: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/withdrawal/{self.order}/{self.hash}"


class ResultKey(_Key, frozen=True):
    """A Result of `liability` with this message hash; put by the promisor."""

    lighthouse: str
    liability: str
    hash: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/result/{self.liability}/{self.hash}"


class FeedbackKey(_Key, frozen=True):
    """A generation-5 provider's feedback on the order with the hash `order`; `hash` distinguishes several."""

    lighthouse: str
    order: str
    hash: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/feedback/{self.order}/{self.hash}"


class PendingKey(_Key, frozen=True):
    """A generation-5 provider's note of the transaction `tx` that it has sent."""

    lighthouse: str
    tx: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/pending/{self.tx}"


class RejectKey(_Key, frozen=True):
    """The reason why `provider` rejects the order or result with the hash `order`."""

    lighthouse: str
    order: str
    provider: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/reject/{self.order}/{self.provider}"


class PresenceKey(_Key, frozen=True):
    """The liveliness token of `agent` in its role (`provider`, `agent`, `edge`, …); no wildcard matches `@agent`."""

    lighthouse: str
    role: str
    agent: str

    def __str__(self) -> str:
        return f"aira/{self.lighthouse}/@agent/{self.role}/{self.agent}"


class CidKey(_Key, frozen=True):
    """A block or a file by its CID; answered by every store that has it."""

    cid: str

    def __str__(self) -> str:
        return f"aira/cid/{self.cid}"


MarketKey: TypeAlias = DemandKey | OfferKey | WithdrawalKey | ResultKey | FeedbackKey | PendingKey | RejectKey
Key: TypeAlias = MarketKey | AgentKey | PresenceKey | CidKey


def market_key(lighthouse: str, kind: MarketKind, chunk: str, digest: str) -> str:
    """The key of a message whose parts are canonical already, without the checks.

    `chunk` is its model, order or liability.
    """
    return f"aira/{lighthouse}/{kind}/{chunk}/{digest}"


def market_kind(text: str) -> str:
    """The kind that a key on a lighthouse names; any text, because this checks nothing."""
    return text.split("/", 3)[2] if text.count("/") > 1 else ""


def parse_key(text: str) -> Key:
    """The key with this text. Raises `InvalidKey` if there is none, or if it is not in the canonical form."""
    check_length(text)
    return check_canonical(text, _parse(text))


def _parse(text: str) -> Key:
    match text.split("/"):
        case ["aira", lighthouse, "demand", model, digits]:
            return DemandKey(lighthouse, model, digits)
        case ["aira", lighthouse, "offer", model, digits]:
            return OfferKey(lighthouse, model, digits)
        case ["aira", lighthouse, "withdrawal", order, digits]:
            return WithdrawalKey(lighthouse, order, digits)
        case ["aira", lighthouse, "result", liability, digits]:
            return ResultKey(lighthouse, liability, digits)
        case ["aira", "agent", *_]:
            return parse_agent_key(text)
        case ["aira", "cid", cid]:
            return CidKey(cid)
        case ["aira", lighthouse, "feedback", order, digits]:
            return FeedbackKey(lighthouse, order, digits)
        case ["aira", lighthouse, "pending", tx]:
            return PendingKey(lighthouse, tx)
        case ["aira", lighthouse, "reject", order, provider]:
            return RejectKey(lighthouse, order, provider)
        case ["aira", lighthouse, "@agent", role, agent]:
            return PresenceKey(lighthouse, role, agent)
    raise InvalidKey(text, "there is no such family")

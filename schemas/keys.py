"""The keyspace: all keys and their meaning.

`str(key)` is the text of a key, `parse_key` parses one; both make the same checks, because Zenoh itself accepts blanks,
line ends and NUL in a key. Each key has exactly one text. `schemas.selectors` has the selectors for subscribers and
queries.

A lighthouse is given by its ENS name in lower case, or by its address if it has none. Addresses are in lower case (the
classes accept any case), hashes are 64 hexadecimal digits in lower case without `0x`. A topic is written as in ROS,
`/a/b`, and becomes the chunks `a/b`. To add a family of keys, add its class, its pattern in `_parse`, and a selector.
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

from msgspec import Struct
from msgspec.structs import force_setattr

from schemas.errors import InvalidKey
from schemas.key_chunks import CANONICAL, check_event

LiabilityEvent: TypeAlias = Literal["incoming", "ready", "complete", "finalized"]
EthEvent: TypeAlias = Literal["transfer", "approval"]
MarketKind: TypeAlias = Literal["demand", "offer", "withdrawal", "result", "feedback", "pending", "reject"]

MAX_KEY_LENGTH: Final = 512


class _Key(Struct, frozen=True, gc=False):
    """The base of all keys. Constructing one raises `InvalidKey` if a field is not valid in a key."""

    def __post_init__(self) -> None:
        for field in self.__struct_fields__:
            text = getattr(self, field)
            canonical = CANONICAL[field](text)
            if canonical != text:
                force_setattr(self, field, canonical)


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


class EventKey(_Key, frozen=True):
    """What happened to `liability`: `incoming`, `ready`, `complete` or `finalized`; put by the agent."""

    agent: str
    liability: str
    event: LiabilityEvent

    def __post_init__(self) -> None:
        _Key.__post_init__(self)
        check_event(self.event, "incoming", "ready", "complete", "finalized")

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/{self.event}"


class ObjectiveTopicKey(_Key, frozen=True):
    """A topic of the objective of `liability`, as the agent plays it."""

    agent: str
    liability: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/objective{self.topic}"


class LiabilityTopicKey(_Key, frozen=True):
    """A topic of the job for `liability`, on which the device publishes; it is recorded."""

    agent: str
    liability: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/topic{self.topic}"


class DeviceTopicKey(_Key, frozen=True):
    """A topic of a device outside any job."""

    agent: str
    device: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/device/{self.device}{self.topic}"


class RpcKey(_Key, frozen=True):
    """A service of the agent, a queryable: `start`, `finish`, `eth/accounts`, …"""

    agent: str
    service: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/rpc/{self.service}"


class EthEventKey(_Key, frozen=True):
    """An event of the token that concerns the agent: `transfer` or `approval`."""

    agent: str
    event: EthEvent

    def __post_init__(self) -> None:
        _Key.__post_init__(self)
        check_event(self.event, "transfer", "approval")

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/eth/event/{self.event}"


class CidKey(_Key, frozen=True):
    """A block or a file by its CID; answered by every store that has it."""

    cid: str

    def __str__(self) -> str:
        return f"aira/cid/{self.cid}"


MarketKey: TypeAlias = DemandKey | OfferKey | WithdrawalKey | ResultKey | FeedbackKey | PendingKey | RejectKey
AgentKey: TypeAlias = EventKey | ObjectiveTopicKey | LiabilityTopicKey | DeviceTopicKey | RpcKey | EthEventKey
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
    if len(text) > MAX_KEY_LENGTH:
        raise InvalidKey(text, f"it is longer than {MAX_KEY_LENGTH} characters")
    if str(key := _parse(text)) != text:
        raise InvalidKey(text, f"its canonical form is {key}")
    return key


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
        case ["aira", "agent", agent, *path]:
            return _parse_of_agent(text, agent, path)
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


def _parse_of_agent(text: str, agent: str, path: list[str]) -> AgentKey:
    match path:
        case ["liability", liability, "objective", *topic] if topic:
            return ObjectiveTopicKey(agent, liability, "/" + "/".join(topic))
        case ["liability", liability, "topic", *topic] if topic:
            return LiabilityTopicKey(agent, liability, "/" + "/".join(topic))
        case ["liability", liability, event]:
            return EventKey(agent, liability, event)  # type: ignore[arg-type]
        case ["device", device, *topic] if topic:
            return DeviceTopicKey(agent, device, "/" + "/".join(topic))
        case ["rpc", *service]:
            return RpcKey(agent, "/".join(service))
        case ["eth", "event", event]:
            return EthEventKey(agent, event)  # type: ignore[arg-type]
    raise InvalidKey(text, "there is no such family under an agent")

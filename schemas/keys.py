"""The keyspace: all keys, their meaning, and the selectors for subscribers and queries.

`str(key)` is the text of a key, `parse_key` parses one; both make the same checks, because Zenoh itself accepts blanks,
line ends and NUL in a key. Each key has exactly one text. The functions `…_chunk` and `…_chunks` return the canonical
form of a part of it, or raise `InvalidKey`: no wildcards, blanks, control characters or empty chunks, and no `@` at the
beginning.

A lighthouse is given by its ENS name in lower case, or by its address if it has none. Addresses are in lower case (the
classes accept any case). A topic is written as in ROS, `/a/b`, and becomes the chunks `a/b`. To add a family of keys,
add its class, its place in `AgentKey`, or in `MarketKey` and `KINDS`, and a selector.

A market's keys name only what subscribers select by: the model of an order, the maker of what is rejected or declined.
Hashes are not in them. A router looks up a key that somebody subscribed to, but compares a new one with all its
siblings, so the cost of a message would grow with the number of models.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping  # msgspec reads the annotations
from functools import lru_cache
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, NamedTuple, TypeAlias, TypeVar, get_args

from msgspec import Struct
from msgspec.structs import astuple, force_setattr

from schemas.address import parse_address, parse_address_or_name
from schemas.cid import CACHED, parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidKey

PublishedPhase: TypeAlias = Literal["incoming", "ready", "complete", "finalized"]
EthEvent: TypeAlias = Literal["transfer", "approval"]

KeyT = TypeVar("KeyT", bound="BaseKey")


class KeyLimits(NamedTuple):
    """How many characters keys have."""

    key: int = 512
    """A whole key."""
    path: int = 256
    """A name, or several separated by `/`."""


KEY_LIMITS: Final = KeyLimits()
PRESENT: Final = "/present"
"""The topic of a device's liveliness token, which exists as long as the device answers."""
IDLE: Final = "/aira/idle"
"""The topic on which the process of a device answers once the device has done all that it was told before."""
STOP: Final = "/aira/stop"
"""The topic on which the process of a device answers once the device has heard that it must stop (`DeviceStop`)."""

_CHUNK: Final = r"[A-Za-z0-9_~-][A-Za-z0-9_.~-]*"
_ONE_CHUNK: Final = re.compile(_CHUNK)
_HASH: Final = re.compile("[0-9a-f]{64}")
_CHUNKS: Final = re.compile(rf"{_CHUNK}(?:/{_CHUNK})*")


@lru_cache(maxsize=CACHED)
def address_chunk(text: str) -> str:
    try:
        return parse_address(text).lower()
    except InvalidAddress as error:
        raise InvalidKey(text, str(error)) from None


def cid_chunk(text: str) -> str:
    try:
        parse_cid(text)
    except InvalidCid as error:
        raise InvalidKey(text, str(error)) from None
    return text


def name_chunk(text: str) -> str:
    """A freely chosen name: a role, a device."""
    if len(text) > KEY_LIMITS.path or not _ONE_CHUNK.fullmatch(text):
        raise InvalidKey(text, "a name consists of letters, digits, - _ ~ and, after the first character, dots")
    return text


def _event_of(known: Any) -> Callable[[str], str]:
    def check(text: str) -> str:
        if text not in get_args(known):
            raise InvalidKey(text, f"it is not one of the events {', '.join(get_args(known))}")
        return text

    return check


def path_chunks(text: str) -> str:
    """Several names separated by `/`: a service."""
    if len(text) > KEY_LIMITS.path or not _CHUNKS.fullmatch(text):
        raise InvalidKey(text, f"a path is names separated by /, at most {KEY_LIMITS.path} characters long")
    return text


def topic_chunks(text: str) -> str:
    """A topic as in ROS: `/`, and names separated by `/`."""
    if not text.startswith("/"):
        raise InvalidKey(text, "a topic begins with /")
    path_chunks(text[1:])
    return text


@lru_cache(maxsize=CACHED)
def lighthouse_chunk(text: str) -> str:
    """A lighthouse: its ENS name, or its address if it has none; in lower case."""
    try:
        return parse_address_or_name(text).lower()
    except InvalidAddress:
        raise InvalidKey(text, "a lighthouse is named by an ENS name or an address") from None


class BaseKey(Struct, frozen=True, gc=False):
    """The base of all keys. Constructing one raises `InvalidKey` if a field is not valid in a key."""

    checks: ClassVar[Mapping[str, Callable[[str], str]]] = {
        "agent": address_chunk,
        "liability": address_chunk,
        "cid": cid_chunk,
        "device": name_chunk,
        "service": path_chunks,
        "topic": topic_chunks,
        "lighthouse": lighthouse_chunk,
        "maker": address_chunk,
        "validator": address_chunk,
        "model": cid_chunk,
        "role": name_chunk,
    }
    """The check of each field, by the field's name."""
    pattern: ClassVar[str]
    """The text of a key, with its fields in braces, in their order."""
    _format: ClassVar[str]

    def __init_subclass__(cls) -> None:
        cls._format = re.sub("{.*?}", "%s", getattr(cls, "pattern", ""))

    def __str__(self) -> str:
        return self._format % astuple(self)

    def __post_init__(self) -> None:
        for field in self.__struct_fields__:
            text = getattr(self, field)
            canonical = self.checks[field](text)
            if canonical != text:
                force_setattr(self, field, canonical)


class ProgressKey(BaseKey, frozen=True):
    """How far the playback for `liability` is, a `PlaybackPosition`; put by the agent."""

    pattern: ClassVar = "aira/agent/{agent}/liability/{liability}/progress"
    agent: str
    liability: str


class EventKey(BaseKey, frozen=True):
    """What happened to `liability`: `incoming`, `ready`, `complete` or `finalized`; put by the agent."""

    pattern: ClassVar = "aira/agent/{agent}/liability/{liability}/{event}"
    checks: ClassVar = {**BaseKey.checks, "event": _event_of(PublishedPhase)}
    agent: str
    liability: str
    event: PublishedPhase


class ObjectiveTopicKey(BaseKey, frozen=True):
    """A topic of the objective of `liability`, as the agent plays it."""

    pattern: ClassVar = "aira/agent/{agent}/liability/{liability}/objective{topic}"
    agent: str
    liability: str
    topic: str


class LiabilityTopicKey(BaseKey, frozen=True):
    """A topic of the job for `liability`, on which the device publishes; it is recorded."""

    pattern: ClassVar = "aira/agent/{agent}/liability/{liability}/topic{topic}"
    agent: str
    liability: str
    topic: str


class DeviceTopicKey(BaseKey, frozen=True):
    """A topic of a device outside any job."""

    pattern: ClassVar = "aira/agent/{agent}/device/{device}{topic}"
    agent: str
    device: str
    topic: str


class ReadingKey(BaseKey, frozen=True):
    """A topic on which the agent publishes outside any job: `/battery`."""

    pattern: ClassVar = "aira/agent/{agent}/reading{topic}"
    agent: str
    topic: str


class ProfileKey(BaseKey, frozen=True):
    """What a robot says of itself, a `Profile`; put by the agent when it changes, and answered to queries."""

    pattern: ClassVar = "aira/agent/{agent}/profile"
    agent: str


class RpcKey(BaseKey, frozen=True):
    """A service of the agent, a queryable: `start`, `finish`, `eth/accounts`, …"""

    pattern: ClassVar = "aira/agent/{agent}/rpc/{service}"
    agent: str
    service: str


class EthEventKey(BaseKey, frozen=True):
    """An event of the token that concerns the agent: `transfer` or `approval`."""

    pattern: ClassVar = "aira/agent/{agent}/eth/event/{event}"
    checks: ClassVar = {**BaseKey.checks, "event": _event_of(EthEvent)}
    agent: str
    event: EthEvent


class CidKey(BaseKey, frozen=True):
    """A block or a file by its CID, which the agent's store answers. `*` in place of the agent asks all stores."""

    pattern: ClassVar = "aira/agent/{agent}/cid/{cid}"
    agent: str
    cid: str


# The first that fits decides, so the key with a fixed last chunk goes before the one with any.
AgentKey: TypeAlias = (
    ProgressKey
    | EventKey
    | ObjectiveTopicKey
    | LiabilityTopicKey
    | DeviceTopicKey
    | ReadingKey
    | ProfileKey
    | RpcKey
    | EthEventKey
    | CidKey
)


def key_parser(*kinds: type[KeyT]) -> Callable[[str], KeyT]:
    """A function that parses the texts of these kinds of keys.

    It raises `InvalidKey` for a text of none of them, and for one that is not in the canonical form.
    """
    by_name = {kind.__name__: kind for kind in kinds}
    expression = re.compile("|".join(f"(?P<{kind.__name__}>{_expression(kind.pattern)})" for kind in kinds))

    def parse(text: str) -> KeyT:
        if len(text) > KEY_LIMITS.key:
            raise InvalidKey(text, f"it is longer than {KEY_LIMITS.key} characters")
        found = expression.fullmatch(text)
        if found is None or found.lastgroup is None:
            raise InvalidKey(text, "there is no such family")
        kind, first = by_name[found.lastgroup], expression.groupindex[found.lastgroup]
        key = kind(*found.groups()[first : first + len(kind.__struct_fields__)])
        if str(key) != text:
            raise InvalidKey(text, f"its canonical form is {key}")
        return key

    return parse


def _expression(pattern: str) -> str:
    """What the texts of a pattern match. A topic begins with a slash and, like a service, may have several chunks."""
    of_field = {"topic": "/.+", "service": ".+"}
    return re.sub("{(.*?)}", lambda name: f"({of_field.get(name[1], '[^/]+')})", pattern)


AGENT_KEYS: Final = get_args(AgentKey)
parse_agent_key: Final[Callable[[str], AgentKey]] = key_parser(*AGENT_KEYS)


MarketKind: TypeAlias = Literal[
    "demand", "offer", "withdrawal", "permit", "result", "feedback", "pending", "created", "reject", "decline", "report"
]


class LighthouseKey(BaseKey, frozen=True, gc=False):
    """The base of the keys that are not an agent's."""

    lighthouse: str


class DemandKey(LighthouseKey, frozen=True):
    """The Demands for `model`; put by promisees."""

    pattern: ClassVar = "aira/{lighthouse}/demand/{model}"
    model: str


class OfferKey(LighthouseKey, frozen=True):
    """The Offers of `model`; put by promisors."""

    pattern: ClassVar = "aira/{lighthouse}/offer/{model}"
    model: str


class WithdrawalKey(LighthouseKey, frozen=True):
    """The Withdrawals of orders; put by the orders' makers."""

    pattern: ClassVar = "aira/{lighthouse}/withdrawal"


class PermitKey(LighthouseKey, frozen=True):
    """The Permits beside demands; put by promisees."""

    pattern: ClassVar = "aira/{lighthouse}/permit"


class ResultKey(LighthouseKey, frozen=True):
    """The Results of liabilities; put by promisors."""

    pattern: ClassVar = "aira/{lighthouse}/result"


class FeedbackKey(LighthouseKey, frozen=True):
    """The feedback of generation-5 providers on orders."""

    pattern: ClassVar = "aira/{lighthouse}/feedback"


class PendingKey(LighthouseKey, frozen=True):
    """The notes of generation-5 providers of the transactions that they have sent."""

    pattern: ClassVar = "aira/{lighthouse}/pending"


class RejectKey(LighthouseKey, frozen=True):
    """The providers' rejections of orders and results that `maker` has signed."""

    pattern: ClassVar = "aira/{lighthouse}/reject/{maker}"
    maker: str


class CreatedKey(LighthouseKey, frozen=True):
    """Notices of new contracts of a model, put by providers at once; who needs to know looks at the chain then."""

    pattern: ClassVar = "aira/{lighthouse}/created/{model}"
    model: str


class DeclineKey(LighthouseKey, frozen=True):
    """The agents' declines of demands that `maker` has signed."""

    pattern: ClassVar = "aira/{lighthouse}/decline/{maker}"
    maker: str


class ReportKey(LighthouseKey, frozen=True):
    """The validators' reports on results of liabilities of which `maker` is a party; put by validators.

    A query for `…?liability=ADDRESS` asks them for earlier reports.
    """

    pattern: ClassVar = "aira/{lighthouse}/report/{maker}"
    maker: str


class ValidatorKey(LighthouseKey, frozen=True):
    """The announcements of `validator`, one of each of its jurors; validators answer queries of it."""

    pattern: ClassVar = "aira/{lighthouse}/validator/{validator}"
    validator: str


class PresenceKey(LighthouseKey, frozen=True):
    """The liveliness token of `agent` in its role (`provider`, `agent`, `edge`, …); no wildcard matches `@agent`."""

    pattern: ClassVar = "aira/{lighthouse}/@agent/{role}/{agent}"
    role: str
    agent: str


MarketKey: TypeAlias = (
    DemandKey
    | OfferKey
    | WithdrawalKey
    | PermitKey
    | ResultKey
    | FeedbackKey
    | PendingKey
    | CreatedKey
    | RejectKey
    | DeclineKey
    | ReportKey
)
Key: TypeAlias = MarketKey | AgentKey | ValidatorKey | PresenceKey


class Kind(NamedTuple):
    """A kind of message on a market's keys."""

    key: type[MarketKey]
    put_by: tuple[str, ...]
    """The roles that may publish it on a site (`mesh.ops.identity.roster`)."""
    is_legacy: bool = False
    """Whether the legacy network has it, so that the bridge to IPFS relays it."""

    @property
    def subject(self) -> str:
        """What its key names besides the market: `model`, `maker`, or nothing."""
        return self.key.__struct_fields__[1] if len(self.key.__struct_fields__) > 1 else ""


KINDS: Final[Mapping[MarketKind, Kind]] = MappingProxyType(
    {
        "demand": Kind(DemandKey, ("person", "bridge"), is_legacy=True),
        "offer": Kind(OfferKey, ("agent", "bridge"), is_legacy=True),
        "withdrawal": Kind(WithdrawalKey, ("agent", "person", "bridge")),
        "permit": Kind(PermitKey, ("person",)),
        "result": Kind(ResultKey, ("agent", "validator", "bridge"), is_legacy=True),
        "feedback": Kind(FeedbackKey, ("provider", "bridge"), is_legacy=True),
        "pending": Kind(PendingKey, ("provider", "bridge"), is_legacy=True),
        "created": Kind(CreatedKey, ("provider",)),
        "reject": Kind(RejectKey, ("provider",)),
        "decline": Kind(DeclineKey, ("agent",)),
        "report": Kind(ReportKey, ("validator",)),
    }
)
"""Every kind of message on a market. `schemas.messages` has the classes of those that markets check."""


def market_key(lighthouse: str, kind: MarketKind, model: str) -> str:
    """The key of a message whose parts are canonical already, without the checks. `model` is empty but for orders."""
    return f"aira/{lighthouse}/{kind}/{model}" if model else f"aira/{lighthouse}/{kind}"


def market_kind(text: str) -> str:
    """The kind that a key on a lighthouse names; any text, because this checks nothing."""
    return text.split("/", 3)[2] if text.count("/") > 1 else ""


_ALL: Final = (*(kind.key for kind in KINDS.values()), ValidatorKey, PresenceKey, *AGENT_KEYS)
parse_key: Final[Callable[[str], Key]] = key_parser(*_ALL)


ORDER: Final = "order"
"""The parameter of a query for the withdrawals of one order."""
LIABILITY: Final = "liability"
"""The parameter of a query for the reports on one liability."""


def market_selector(lighthouse: str, kind: MarketKind, subject: str = "*") -> str:
    """All messages of a kind on a lighthouse, or those of one subject.

    The subject is the model of a demand, an offer or a new contract, the maker (an address) of what is rejected or
    declined, or a party of the liability that a report is on. Other kinds have none.
    """
    if kind not in KINDS:
        raise InvalidKey(kind, f"it is not one of the kinds {', '.join(KINDS)}")
    base = f"aira/{lighthouse_chunk(lighthouse)}/{kind}"
    if named := KINDS[kind].subject:
        return f"{base}/{_any_or(BaseKey.checks[named], subject)}"
    if subject != "*":
        raise InvalidKey(subject, f"the key of a {kind} has no such part")
    return base


def withdrawal_selector(lighthouse: str, order: str) -> str:
    """For a query: the withdrawals of the order with this hash (64 hexadecimal digits)."""
    if not _HASH.fullmatch(order):
        raise InvalidKey(order, "a hash is 64 hexadecimal digits in lower case, without 0x")
    return f"{market_selector(lighthouse, 'withdrawal')}?{ORDER}={order}"


def report_selector(lighthouse: str, party: str, liability: str) -> str:
    """For a query: the validators' reports on a liability, one of whose parties is `party`; both are addresses."""
    return f"{market_selector(lighthouse, 'report', party)}?{LIABILITY}={address_chunk(liability)}"


def lighthouse_selector(lighthouse: str) -> str:
    """All messages on a lighthouse's market; presence tokens are not matched by wildcards."""
    return f"aira/{lighthouse_chunk(lighthouse)}/**"


def presence_selector(lighthouse: str, role: str = "*", agent: str = "*") -> str:
    """The presence tokens of all agents on a lighthouse, or of those in one role, or of one agent."""
    return f"aira/{lighthouse_chunk(lighthouse)}/@agent/{_any_or(name_chunk, role)}/{_any_or(address_chunk, agent)}"


def job_selector(agent: str, liability: str) -> str:
    """All of one liability of an agent: its events, and the topics of its objective and its devices."""
    return f"aira/agent/{address_chunk(agent)}/liability/{address_chunk(liability)}/**"


def event_selector(agent: str = "*", liability: str = "*") -> str:
    """The events of an agent's liability and the progress of its playback; by default of all agents and liabilities."""
    return f"aira/agent/{_any_or(address_chunk, agent)}/liability/{_any_or(address_chunk, liability)}/*"


def objective_selector(agent: str, liability: str = "*") -> str:
    """All topics of the objective of a liability of an agent, or of any of its liabilities."""
    return f"aira/agent/{address_chunk(agent)}/liability/{_any_or(address_chunk, liability)}/objective/**"


def topic_selector(agent: str, liability: str = "*", topic: str = "/**") -> str:
    """The topics that a device publishes for one liability of an agent or for any: all of them, or one."""
    of_topic = topic if topic == "/**" else topic_chunks(topic)
    return f"aira/agent/{address_chunk(agent)}/liability/{_any_or(address_chunk, liability)}/topic{of_topic}"


def device_selector(agent: str, device: str = "*", topic: str = "/**") -> str:
    """The topics outside any job, all of them or one, of one device of an agent, or of all its devices."""
    return f"aira/agent/{address_chunk(agent)}/device/{_any_or(name_chunk, device)}{topic}"


def any_topic_selector(agent: str, topic: str) -> str:
    """A topic of an agent's devices and jobs. Other keys of the agent that end in it are matched, too."""
    return f"aira/agent/{address_chunk(agent)}/*/*/**{topic_chunks(topic)}"


def reading_selector(agent: str = "*", topic: str = "/**") -> str:
    """What an agent, or any, publishes outside any job: on all topics, or on one."""
    of_topic = topic if topic == "/**" else topic_chunks(topic)
    return f"aira/agent/{_any_or(address_chunk, agent)}/reading{of_topic}"


def cid_selector(agent: str = "*", cid: str = "*") -> str:
    """A block or a file in the store of one agent or of any; or all that an agent's store has."""
    return f"aira/agent/{_any_or(address_chunk, agent)}/cid/{_any_or(cid_chunk, cid)}"


def requested_cid(selector: str) -> str | None:
    """The CID of the one block that a query of `cid_selector` requests; None if it has a wildcard there."""
    match selector.split("/"):
        case ["aira", "agent", _, "cid", cid]:
            try:
                return cid_chunk(cid)
            except InvalidKey:
                return None
    return None


def _any_or(check: Callable[[str], str], text: str) -> str:
    """The wildcard for one chunk, or a checked chunk."""
    return text if text == "*" else check(text)

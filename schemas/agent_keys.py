"""The keys of an agent: its jobs, its devices, its services and its content; and the checks of what keys consist of.

The functions `…_chunk` and `…_chunks` return the canonical form of a text, or raise `InvalidKey`. Accepted texts
contain no wildcards, blanks, control characters or empty chunks, and do not begin with `@`. Keys of markets are in
`schemas.keys`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping  # msgspec reads the annotations
from functools import lru_cache
from typing import Any, ClassVar, Final, Generic, Literal, TypeAlias, TypeVar, get_args

from msgspec import Struct
from msgspec.structs import astuple, force_setattr

from schemas.address import parse_address
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidCid, InvalidKey

LiabilityEvent: TypeAlias = Literal["incoming", "ready", "complete", "finalized"]
EthEvent: TypeAlias = Literal["transfer", "approval"]

KeyT = TypeVar("KeyT", bound="BaseKey")

CACHED: Final = 8192
"""The most texts whose canonical form a check remembers."""
MAX_KEY_LENGTH: Final = 512
MAX_PATH_LENGTH: Final = 256

_CHUNK: Final = r"[A-Za-z0-9_~-][A-Za-z0-9_.~-]*"
_ONE_CHUNK: Final = re.compile(_CHUNK)
_CHUNKS: Final = re.compile(rf"{_CHUNK}(?:/{_CHUNK})*")


@lru_cache(maxsize=CACHED)
def address_chunk(text: str) -> str:
    """An address, in lower case."""
    try:
        return parse_address(text).lower()
    except InvalidAddress as error:
        raise InvalidKey(text, str(error)) from None


def cid_chunk(text: str) -> str:
    """A CIDv0."""
    try:
        parse_cid(text)
    except InvalidCid as error:
        raise InvalidKey(text, str(error)) from None
    return text


def name_chunk(text: str) -> str:
    """A freely chosen name: a role, a device."""
    if len(text) > MAX_PATH_LENGTH or not _ONE_CHUNK.fullmatch(text):
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
    if len(text) > MAX_PATH_LENGTH or not _CHUNKS.fullmatch(text):
        raise InvalidKey(text, f"a path is names separated by /, at most {MAX_PATH_LENGTH} characters long")
    return text


def topic_chunks(text: str) -> str:
    """A topic as in ROS: `/`, and names separated by `/`."""
    if not text.startswith("/"):
        raise InvalidKey(text, "a topic begins with /")
    path_chunks(text[1:])
    return text


class BaseKey(Struct, frozen=True, gc=False):
    """The base of all keys. Constructing one raises `InvalidKey` if a field is not valid in a key."""

    checks: ClassVar[Mapping[str, Callable[[str], str]]] = {
        "agent": address_chunk,
        "liability": address_chunk,
        "cid": cid_chunk,
        "device": name_chunk,
        "service": path_chunks,
        "topic": topic_chunks,
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
    checks: ClassVar = {**BaseKey.checks, "event": _event_of(LiabilityEvent)}
    agent: str
    liability: str
    event: LiabilityEvent


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
    | RpcKey
    | EthEventKey
    | CidKey
)


class KeyParser(Generic[KeyT]):
    """Parses the texts of these kinds of keys."""

    def __init__(self, *kinds: type[KeyT]) -> None:
        self._kinds = {kind.__name__: kind for kind in kinds}
        self._expression = re.compile("|".join(f"(?P<{kind.__name__}>{_expression(kind.pattern)})" for kind in kinds))

    def parse(self, text: str) -> KeyT:
        """The key with this text. Raises `InvalidKey` if there is none, or if it is not in the canonical form."""
        if len(text) > MAX_KEY_LENGTH:
            raise InvalidKey(text, f"it is longer than {MAX_KEY_LENGTH} characters")
        found = self._expression.fullmatch(text)
        if found is None or found.lastgroup is None:
            raise InvalidKey(text, "there is no such family")
        kind, first = self._kinds[found.lastgroup], self._expression.groupindex[found.lastgroup]
        key = kind(*found.groups()[first : first + len(kind.__struct_fields__)])
        if str(key) != text:
            raise InvalidKey(text, f"its canonical form is {key}")
        return key


def _expression(pattern: str) -> str:
    """What the texts of a pattern match. A topic begins with a slash and, like a service, may have several chunks."""
    of_field = {"topic": "/.+", "service": ".+"}
    return re.sub("{(.*?)}", lambda name: f"({of_field.get(name[1], '[^/]+')})", pattern)


AGENT_KEYS: Final = get_args(AgentKey)
parse_agent_key: Final = KeyParser[AgentKey](*AGENT_KEYS).parse
"""The key of an agent with a text. Raises `InvalidKey` if there is none, or if it is not in the canonical form."""

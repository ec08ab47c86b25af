"""The keys of an agent: its jobs, its devices, its services and its content; and the checks of what keys consist of.

The functions `…_chunk` and `…_chunks` return the canonical form of a text, or raise `InvalidKey`. Accepted texts
contain no wildcards, blanks, control characters or empty chunks, and do not begin with `@`. Keys of markets are in
`schemas.keys`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping  # msgspec reads the annotations
from functools import lru_cache
from typing import ClassVar, Final, Literal, TypeAlias, TypeVar

from msgspec import Struct
from msgspec.structs import force_setattr

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


def check_event(text: str, *known: str) -> None:
    """Raise `InvalidKey` for an event that is not one of `known`."""
    if text not in known:
        raise InvalidKey(text, f"it is not one of the events {', '.join(known)}")


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
        "event": name_chunk,
        "service": path_chunks,
        "topic": topic_chunks,
    }
    """The check of each field, by the field's name."""

    def __post_init__(self) -> None:
        for field in self.__struct_fields__:
            text = getattr(self, field)
            canonical = self.checks[field](text)
            if canonical != text:
                force_setattr(self, field, canonical)


class EventKey(BaseKey, frozen=True):
    """What happened to `liability`: `incoming`, `ready`, `complete` or `finalized`; put by the agent."""

    agent: str
    liability: str
    event: LiabilityEvent

    def __post_init__(self) -> None:
        BaseKey.__post_init__(self)
        check_event(self.event, "incoming", "ready", "complete", "finalized")

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/{self.event}"


class ObjectiveTopicKey(BaseKey, frozen=True):
    """A topic of the objective of `liability`, as the agent plays it."""

    agent: str
    liability: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/objective{self.topic}"


class LiabilityTopicKey(BaseKey, frozen=True):
    """A topic of the job for `liability`, on which the device publishes; it is recorded."""

    agent: str
    liability: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/liability/{self.liability}/topic{self.topic}"


class DeviceTopicKey(BaseKey, frozen=True):
    """A topic of a device outside any job."""

    agent: str
    device: str
    topic: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/device/{self.device}{self.topic}"


class RpcKey(BaseKey, frozen=True):
    """A service of the agent, a queryable: `start`, `finish`, `eth/accounts`, …"""

    agent: str
    service: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/rpc/{self.service}"


class EthEventKey(BaseKey, frozen=True):
    """An event of the token that concerns the agent: `transfer` or `approval`."""

    agent: str
    event: EthEvent

    def __post_init__(self) -> None:
        BaseKey.__post_init__(self)
        check_event(self.event, "transfer", "approval")

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/eth/event/{self.event}"


class CidKey(BaseKey, frozen=True):
    """A block or a file by its CID, which the agent's store answers. `*` in place of the agent asks all stores."""

    agent: str
    cid: str

    def __str__(self) -> str:
        return f"aira/agent/{self.agent}/cid/{self.cid}"


AgentKey: TypeAlias = EventKey | ObjectiveTopicKey | LiabilityTopicKey | DeviceTopicKey | RpcKey | EthEventKey | CidKey


def parse_agent_key(text: str) -> AgentKey:
    """The key of an agent with this text. Raises `InvalidKey` if there is none, or if it is not in canonical form."""
    check_length(text)
    match text.split("/"):
        case ["aira", "agent", agent, *path]:
            return check_canonical(text, _parse_path(text, agent, path))
    raise InvalidKey(text, "it is no key of an agent")


def check_length(text: str) -> None:
    """Raise `InvalidKey` for a text that is too long for a key."""
    if len(text) > MAX_KEY_LENGTH:
        raise InvalidKey(text, f"it is longer than {MAX_KEY_LENGTH} characters")


def check_canonical(text: str, key: KeyT) -> KeyT:
    """The key, if `text` is its canonical form. Raises `InvalidKey`."""
    if str(key) != text:
        raise InvalidKey(text, f"its canonical form is {key}")
    return key


def _parse_path(text: str, agent: str, path: list[str]) -> AgentKey:
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
        case ["cid", cid]:
            return CidKey(agent, cid)
    raise InvalidKey(text, "there is no such family under an agent")

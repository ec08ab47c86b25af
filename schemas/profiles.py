"""What a robot says of itself: who it is, what it is doing, and how long its queue is."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar, Final, Literal, NamedTuple, TypeAlias

from msgspec import Meta, field

from schemas.cid import is_cid
from schemas.errors import InvalidRecord
from schemas.model import PRICE, require_plain_text
from schemas.records import LONGEST_PRICE, Record, check_addresses
from schemas.signing import SignedRecord

ProfileState: TypeAlias = Literal["idle", "working", "stopped", "closed"]


class ProfileLimits(NamedTuple):
    """What a profile may have."""

    size: int = 8192
    """Bytes of it as it is encoded; receivers refuse more."""
    name: int = 80
    """Characters of a robot's name, and of its place."""
    about: int = 200
    """Characters of what a robot says of itself."""
    picture: int = 512 << 10
    """Bytes of a robot's picture."""
    waiting: int = 1_000_000
    """Jobs in a queue, and seconds of a wait, that can be stated."""
    readings: int = 4
    """Topics whose latest readings it has."""
    reading: int = 80
    """Characters of a reading, and of its topic."""
    handovers: int = 4
    """Earlier keys of a robot that can be proved, the latest ones."""


PROFILE_LIMITS: Final = ProfileLimits()

_Waiting: TypeAlias = Annotated[int, Meta(ge=0, le=PROFILE_LIMITS.waiting)]
_Name: TypeAlias = Annotated[str, Meta(max_length=PROFILE_LIMITS.name)]
_Reading: TypeAlias = Annotated[str, Meta(max_length=PROFILE_LIMITS.reading)]


class Handover(SignedRecord, frozen=True, kw_only=True):
    """The word of an account that its robot goes on under another key, of `successor` (EIP-55).

    `time` is the robot's time of day then, Unix seconds.
    It counts only in a profile that the successor has signed, so that both keys say it: see `Profile.predecessors`.
    """

    domain: ClassVar = b"aira handover\0"
    author: ClassVar = "agent"

    agent: str
    successor: str
    time: int


class Profile(SignedRecord, frozen=True, kw_only=True):
    """A robot as its account presents it. The robot answers queries of `ProfileKey`, and puts it there when it changes.

    `agent` is the EIP-55 address of its account, `model` a CIDv0 or empty. `name`, `about` and `place` are plain text
    that the owner chose: two robots may have one name. `picture` is the CID of an image, `price` what a job usually
    costs, as in a description of a model; both may be empty. `queue` jobs wait, and a new one would begin in about
    `wait` seconds. `stopped` says that somebody stopped the robot, `closed` that it takes no jobs now. `readings` are
    the latest ones that the robot has published outside of jobs, as plain text by their topics. `handovers` are those
    by which it got its key, oldest first. `time` is the robot's time of day in Unix seconds. Trust it only if it
    `is_signed`, and is on the agent's key.
    """

    domain: ClassVar = b"aira profile\0"
    author: ClassVar = "agent"

    agent: str
    model: str = ""
    name: _Name = ""
    about: Annotated[str, Meta(max_length=PROFILE_LIMITS.about)] = ""
    picture: str = ""
    place: _Name = ""
    price: Annotated[str, Meta(max_length=LONGEST_PRICE)] = ""
    state: ProfileState = "idle"
    queue: _Waiting = 0
    wait: _Waiting = 0
    readings: Annotated[dict[_Reading, _Reading], Meta(max_length=PROFILE_LIMITS.readings)] = field(
        default_factory=dict
    )
    handovers: Annotated[tuple[Handover, ...], Meta(max_length=PROFILE_LIMITS.handovers)] = ()
    time: int

    @property
    def predecessors(self) -> tuple[str, ...]:
        """The robot's earlier addresses, latest first: each has signed that the next one goes on."""
        found: list[str] = []
        heir = self.agent
        for handover in reversed(self.handovers):
            if handover.successor != heir or handover.agent in (self.agent, *found) or not handover.is_signed:
                break
            found.append(heir := handover.agent)
        return tuple(found)

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        for name in ("name", "about", "place"):
            if why := text_fault(name, getattr(self, name)):
                raise InvalidRecord("Profile", f"{name}: {why}")
        if not all(text.isprintable() for reading in self.readings.items() for text in reading):
            raise InvalidRecord("Profile", "readings: expected plain text")
        for name in ("model", "picture"):
            if (cid := getattr(self, name)) and not is_cid(cid):
                raise InvalidRecord("Profile", f"{name}: expected a CIDv0")
        if self.price and not re.fullmatch(PRICE, self.price):
            raise InvalidRecord("Profile", "price: expected one like `5 XRT`")
        check_addresses(self, "agent")


def text_fault(field: str, text: str) -> str:
    """Why a text can't be the `name`, `about` or `place` of a robot, in a few words; empty if it can."""
    most = PROFILE_LIMITS.about if field == "about" else PROFILE_LIMITS.name
    if len(text) > most:
        return f"it has {len(text)} characters; the most are {most}"
    if field == "name" and text[:2].lower() == "0x":
        return "a name does not begin with 0x, as addresses do"
    try:
        require_plain_text(text)
    except ValueError as error:
        return str(error)
    return ""

"""Records: the JSON objects of services, and the amounts in them.

In a record an amount is a decimal string, as UInt256 was in the legacy stack, because not every JSON reader keeps
numbers beyond 2^53. In Python it is an `int`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeAlias

import msgspec
from msgspec.structs import force_setattr

from schemas.address import ZERO_ADDRESS, parse_address
from schemas.decoding import InvalidData, decode_json
from schemas.errors import InvalidAddress, InvalidRecord

MAX_UINT256: Final = 2**256 - 1
MAX_RECORD_SIZE: Final = 65_536
"""The longest record, in bytes, that is decoded."""

_MAX_TOTAL: Final = 2**53
_MAX_DIGITS: Final = len(str(MAX_UINT256))

if TYPE_CHECKING:
    UInt256: TypeAlias = int
else:

    class UInt256(int):
        """The type of a field with an amount: an `int` that travels as a decimal string."""

        __slots__ = ()


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The base of all records. Constructing one raises `InvalidRecord` if an amount is not from 0 to 2^256-1."""

    def __post_init__(self) -> None:
        for field in _amount_fields(type(self)):
            value = getattr(self, field)
            if type(value) not in (int, UInt256) or not 0 <= value <= MAX_UINT256:
                raise InvalidRecord(type(self).__name__, f"{field}: expected an integer from 0 to 2^256-1")
            force_setattr(self, field, UInt256(value))

    def encode(self) -> bytes:
        """The compact JSON of the record."""
        return _ENCODER.encode(self)

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """The record in `payload`. Raises `InvalidRecord` and nothing else, whatever the bytes are."""
        if len(payload) > MAX_RECORD_SIZE:
            raise InvalidRecord(cls.__name__, f"it has {len(payload)} bytes; the limit is {MAX_RECORD_SIZE}")
        try:
            record = decode_json(payload, cls, _read_amount)
        except InvalidData as error:
            raise InvalidRecord(cls.__name__, str(error)) from None
        if not _has_usual_numbers(record):
            raise InvalidRecord(cls.__name__, "a number is beyond 2^64")
        return record


LONGEST_PRICE: Final = 100
"""Characters of a price."""


class ControlRobot(Record, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """What the owner of a robot changes while it runs; what is left out stays as it is.

    `price` (`6 XRT`) is what its profile and its quotes say; empty for the price of its model's description. While it
    is `paused` it takes no new jobs. `refuse` are the customers (addresses) that it never works for, `least_price` is
    the least cost of a job; empty for any. `stop` says why it is stopped: it takes and begins no job until `release`.
    """

    price: Annotated[str, msgspec.Meta(max_length=LONGEST_PRICE)] | None = None
    paused: bool | None = None
    refuse: Annotated[tuple[str, ...], msgspec.Meta(max_length=1000)] | None = None
    least_price: Annotated[str, msgspec.Meta(max_length=LONGEST_PRICE)] | None = None
    stop: str | None = None
    release: bool = False


class NotifyTarget(Record, frozen=True):
    """Who is told what happens to a robot: the host of a URL, or the name of a program.

    `waiting` events have not reached it yet.
    """

    target: str
    waiting: int


class RobotEvent(Record, frozen=True, kw_only=True):
    """What has happened to a robot, for its owner: `event` is one of `notify_events`, `time` is Unix seconds.

    `about` is the order's hash or the contract's address, if there is one. `detail` says why a job failed, which part
    can't be reached, or how much gas is left (wei).
    """

    event: str
    time: float
    about: str
    detail: str


class RobotControl(Record, frozen=True, kw_only=True, rename="camel"):
    """What is in effect on a robot: as in `ControlRobot`. While it is `held`, it takes and begins no job.

    `stopped` says, for people, what a stop has done. `notify` is told what happens to it; `events` are the latest ones
    since it was started, oldest first, also if nobody is told.
    """

    price: str
    paused: bool
    refuse: tuple[str, ...]
    least_price: str
    held: bool
    stopped: str = ""
    notify: tuple[NotifyTarget, ...] = ()
    events: tuple[RobotEvent, ...] = ()


class Liability(Record, frozen=True, kw_only=True, rename="camel"):
    """A liability contract as agents and clients read it: its parties, its terms, and how it ended.

    Addresses are in EIP-55; `validator` is the zero address if there is none. `model`, `objective` and `result` are
    CIDs; `result` is empty until the liability is finalized. `cost` is in the token's smallest unit, the fees in wn.
    """

    address: str
    model: str
    objective: str
    result: str
    promisee: str
    promisor: str
    lighthouse: str
    lighthouse_fee: UInt256
    token: str
    cost: UInt256
    validator: str
    validator_fee: UInt256
    is_success: bool
    is_finalized: bool

    @classmethod
    def of_nobody(cls, **terms: Any) -> Self:
        """An open liability that no chain knows; where `terms`, its fields, say nothing, it is for nothing."""
        parties = dict.fromkeys(("address", "promisee", "promisor", "lighthouse", "token", "validator"), ZERO_ADDRESS)
        files = dict.fromkeys(("model", "objective", "result"), "")
        amounts = dict.fromkeys(("lighthouse_fee", "cost", "validator_fee"), 0)
        return cls(**(parties | files | amounts | {"is_success": False, "is_finalized": False} | terms))

    @property
    def state(self) -> Literal["open", "paid", "failed", "called-off"]:
        """What has become of it; `called-off` if it ended without a result."""
        if not self.is_finalized:
            return "open"
        if self.is_success:
            return "paid"
        return "failed" if self.result else "called-off"


class PlaybackPosition(Record, frozen=True, kw_only=True):
    """How far a job's playback is: `position` messages of `total` were played and handled."""

    position: int
    total: int

    def __post_init__(self) -> None:
        Record.__post_init__(self)
        if not 0 <= self.position <= self.total < _MAX_TOTAL:
            raise InvalidRecord("PlaybackPosition", f"position: expected one from 0 to the total, below {_MAX_TOTAL}")


def check_addresses(record: Record, *fields: str) -> None:
    """Raise `InvalidRecord` unless these fields of a record have addresses in EIP-55 form."""
    for field in fields:
        try:
            canonical = parse_address(getattr(record, field))
        except InvalidAddress as error:
            raise InvalidRecord(type(record).__name__, f"{field}: {error}") from None
        if canonical != getattr(record, field):
            raise InvalidRecord(type(record).__name__, f"{field}: expected the address in EIP-55 form")


@lru_cache(maxsize=128)
def _amount_fields(kind: type[Record]) -> tuple[str, ...]:
    return tuple(field.name for field in msgspec.structs.fields(kind) if field.type is UInt256)


def _has_usual_numbers(value: Any) -> bool:
    """Whether no number but an amount is so large that a program that calculates with it or prints it fails."""
    match value:
        case UInt256() | bool():
            return True
        case int() | float():
            return abs(value) <= 2**64
        case msgspec.Struct():
            return all(_has_usual_numbers(getattr(value, name)) for name in value.__struct_fields__)
        case dict():
            return all(map(_has_usual_numbers, value.values()))
        case list() | tuple():
            return all(map(_has_usual_numbers, value))
    return True


def _read_amount(_kind: type[Any], value: Any) -> UInt256:
    if not isinstance(value, str) or not (value.isascii() and value.isdigit() and len(value) <= _MAX_DIGITS):
        raise ValueError("Expected an amount, decimal digits in a string")
    return UInt256(value)


_ENCODER: Final = msgspec.json.Encoder(enc_hook=lambda amount: str(int(amount)))


class DeviceStop(Record, frozen=True, kw_only=True):
    """What became of a stop at one device. It was `heard` if the device confirmed it; else `detail` says why not."""

    device: str
    heard: bool
    detail: str = ""

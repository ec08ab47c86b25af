"""Requests for market messages: the agent that is asked signs and publishes one, or publishes one already signed.

The fields have the names that messages have on the wire; amounts are decimal strings, as in all records. Addresses may
be ENS names, and a model may be given by its name.
"""

from __future__ import annotations

from typing import Any, Final, Self

import msgspec

from schemas.errors import InvalidMessage
from schemas.message_fields import MAX_UINT256
from schemas.messages import Demand, Offer, Result
from schemas.records import Record, UInt256

_MAX_DIGITS: Final = len(str(MAX_UINT256))


class _OrderFields(Record, frozen=True, kw_only=True, rename="camel"):
    """The fields that requests for a Demand and for an Offer share."""

    model: str
    objective: str
    token: str
    cost: UInt256
    lighthouse: str
    validator: str
    deadline: UInt256


class SignDemand(_OrderFields, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish a Demand; the agent adds nonce, sender (generation 5) and signature."""

    validator_fee: UInt256

    def unsigned(self, *, nonce: str | int, sender: str | None) -> Demand:
        """The Demand to be signed. Raises `InvalidMessage`."""
        return Demand(**_fields(self), nonce=nonce, sender=sender)


class SignOffer(_OrderFields, frozen=True, kw_only=True, rename="camel"):
    """Sign and publish an Offer; the agent adds nonce, sender (generation 5) and signature."""

    lighthouse_fee: UInt256

    def unsigned(self, *, nonce: str | int, sender: str | None) -> Offer:
        """The Offer to be signed. Raises `InvalidMessage`."""
        return Offer(**_fields(self), nonce=nonce, sender=sender)


class SignResult(Record, frozen=True, kw_only=True):
    """Sign and publish a Result."""

    liability: str
    result: str
    success: bool

    def unsigned(self) -> Result:
        """The Result to be signed. Raises `InvalidMessage`."""
        return Result(**_fields(self))


class SendDemand(_OrderFields, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """Publish a signed Demand. `nonce` is 64 hexadecimal digits, or decimal digits if there is a `sender`."""

    validator_fee: UInt256
    nonce: str
    sender: str | None = None
    signature: str

    @classmethod
    def of(cls, message: Demand) -> Self:
        """The request to publish a message."""
        return cls(**_record(message))

    def message(self) -> Demand:
        """The message to be published. Raises `InvalidMessage`."""
        return Demand(**_signed_fields(self, self.nonce, self.sender))


class SendOffer(_OrderFields, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """Publish a signed Offer. `nonce` is 64 hexadecimal digits, or decimal digits if there is a `sender`."""

    lighthouse_fee: UInt256
    nonce: str
    sender: str | None = None
    signature: str

    @classmethod
    def of(cls, message: Offer) -> Self:
        """The request to publish a message."""
        return cls(**_record(message))

    def message(self) -> Offer:
        """The message to be published. Raises `InvalidMessage`."""
        return Offer(**_signed_fields(self, self.nonce, self.sender))


class SendResult(Record, frozen=True, kw_only=True):
    """Publish a signed Result."""

    liability: str
    result: str
    success: bool
    signature: str

    @classmethod
    def of(cls, message: Result) -> Self:
        """The request to publish a message."""
        return cls(**_record(message))

    def message(self) -> Result:
        """The message to be published. Raises `InvalidMessage`."""
        return Result(**_fields(self))


class Published(Record, frozen=True):
    """The message was published; `hash` is its hash, 64 hexadecimal digits."""

    hash: str


def _fields(request: Record) -> dict[str, Any]:
    """The fields of a request as those of its message, with plain ints as amounts."""
    fields = msgspec.structs.asdict(request)
    return {name: int(value) if isinstance(value, UInt256) else value for name, value in fields.items()}


def _signed_fields(request: Record, nonce: str, sender: str | None) -> dict[str, Any]:
    return _fields(request) | {"nonce": nonce if sender is None else _count(nonce)}


def _count(nonce: str) -> int:
    if not (nonce.isascii() and nonce.isdigit() and len(nonce) <= _MAX_DIGITS):
        raise InvalidMessage("nonce", "the nonce of a generation-5 order is a number in decimal digits")
    return int(nonce)


def _record(message: Demand | Offer | Result) -> dict[str, Any]:
    fields = msgspec.structs.asdict(message)
    return fields | ({"nonce": str(fields["nonce"])} if "nonce" in fields else {})

"""The JSON of the legacy channel: one message, one object.

Reading is strict: unknown, repeated and missing fields, fractions where integers belong, and texts that are not quite
addresses, names or hashes are refused with a reason. Writing is canonical: compact, no `0x` on nonces and signatures.
"""

from __future__ import annotations

from typing import Final, NoReturn

import msgspec

from schemas.errors import InvalidMessage
from schemas.messages import Demand, Message, Offer, OrderFeedback, Result, TransactionFeedback

MAX_MESSAGE_SIZE: Final = 65_536
"""The longest payload, in bytes, that is looked at. Real messages have about 600."""

_KINDS: Final[dict[str, type[Message]]] = {
    "validatorFee": Demand,
    "lighthouseFee": Offer,
    "accepted": OrderFeedback,
    "tx": TransactionFeedback,
    "liability": Result,
}
"""The field that tells the kind of a message; the first that is there decides."""

_MARKS: Final = tuple((f'"{field}"'.encode(), kind) for field, kind in _KINDS.items())
_DECODERS: Final = {kind: msgspec.json.Decoder(kind) for kind in _KINDS.values()}
_FIELDS: Final = {kind: msgspec.structs.fields(kind) for kind in _KINDS.values()}
_FIELD_COUNTS: Final = {kind: len(fields) for kind, fields in _FIELDS.items()}
_ANY_OBJECT: Final = msgspec.json.Decoder(dict[str, msgspec.Raw])
_ENCODER: Final = msgspec.json.Encoder()


def decode(payload: bytes) -> Message:
    """The message in `payload`, checked and in canonical form; its signature is there, but not verified.

    Raises `InvalidMessage` and nothing else, whatever the bytes are. Its `reason` is one of `too-large`, `not-json`,
    `unknown-kind`, `unknown-field`, `duplicate-field`, `field` (missing or of the wrong type), `address`, `cid`,
    `nonce`, `range`, `hash` and `signature`.
    """
    if len(payload) > MAX_MESSAGE_SIZE:
        raise InvalidMessage("too-large", f"{len(payload)} bytes, and {MAX_MESSAGE_SIZE} are the most")
    kind = _kind_of(payload)
    try:
        message = _DECODERS[kind].decode(payload)
    except msgspec.ValidationError as error:
        if isinstance(error.__cause__, InvalidMessage):
            raise error.__cause__ from None
        _explain(payload, kind, str(error))
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidMessage("not-json", str(error)) from None
    count = _FIELD_COUNTS[kind]
    if not isinstance(message, TransactionFeedback) and not message.signature:
        _explain(payload, kind, "the signature is empty", reason="signature")
    if isinstance(message, (Demand, Offer)) and message.sender is None:
        count -= 1
    # The decoder takes the last of repeated fields. No value of a well-formed message holds a colon, so there is one a
    # field, and any more belong to repeated ones.
    if payload.count(b":") != count:
        _explain(payload, kind, "a field is repeated", reason="duplicate-field")
    return message


def encode(message: Message) -> bytes:
    """The compact JSON of a message, with exactly the fields that the legacy network knows.

    Raises `InvalidMessage` (`signature`) if the message should be signed and isn't: such a one must not travel.
    """
    if not isinstance(message, TransactionFeedback) and not message.signature:
        raise InvalidMessage("signature", "the message is not signed; sign it before it travels")
    return _ENCODER.encode(message)


def _kind_of(payload: bytes) -> type[Message]:
    # No value of a well-formed message holds a quotation mark, so a mark that is found is a key. A writer may spell
    # keys with escapes, and then none is found.
    for mark, kind in _MARKS:
        if mark in payload:
            return kind
    present = _fields_of(payload)
    for field, kind in _KINDS.items():
        if field in present:
            return kind
    raise InvalidMessage("unknown-kind", f"none of {', '.join(_KINDS)} is there")


def _fields_of(payload: bytes) -> dict[str, msgspec.Raw]:
    try:
        return _ANY_OBJECT.decode(payload)
    except msgspec.ValidationError as error:
        raise InvalidMessage("unknown-kind", str(error)) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessage("not-json", str(error)) from None


def _explain(payload: bytes, kind: type[Message], detail: str, *, reason: str = "field") -> NoReturn:
    """Say in our own words why `payload` is no message, away from the hot path."""
    present = _fields_of(payload)
    if "validatorFee" in present and "lighthouseFee" in present:
        raise InvalidMessage("unknown-kind", "both validatorFee and lighthouseFee are there")
    fields = _FIELDS[kind]
    unknown = present.keys() - {field.encode_name for field in fields}
    if unknown:
        raise InvalidMessage("unknown-field", f"a {kind.__name__} has no {', '.join(map(repr, sorted(unknown)))}"[:200])
    wanted = {field.encode_name for field in fields if field.name != "sender"}
    if missing := wanted - present.keys():
        raise InvalidMessage("field", f"{', '.join(sorted(missing))} missing")
    if bytes(present.get("sender", b"")) == b"null":
        raise InvalidMessage("field", "sender: expected an address")
    raise InvalidMessage(reason, detail)

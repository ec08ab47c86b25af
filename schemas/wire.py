"""Market messages as bytes: the JSON that travels, the hash that is signed, and what the contracts take.

Reading JSON is strict: unknown, repeated and missing fields, fractions where integers belong, and texts that are not
quite addresses, names or hashes are rejected with a reason. Writing is canonical: compact, no `0x` on nonces and
signatures. Hashes and contract bytes are Solidity's `abi.encodePacked` and `abi.encode`, written out field by field.
"""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, Any, Final, NoReturn

import msgspec

from schemas.address import address_bytes, keccak256
from schemas.cid import CID_LENGTH, parse_ahead, parse_cid
from schemas.errors import InvalidAddress, InvalidMessage
from schemas.messages import MESSAGE_TYPES, Demand, Message, Offer, Order, Result, TransactionFeedback, Withdrawal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

MAX_MESSAGE_SIZE: Final = 16_384
"""The longest payload, in bytes, that is decoded. Real messages have about 700."""

_TYPE_OF_MARK: Final[dict[str, type[Message]]] = {kind.mark: kind for kind in MESSAGE_TYPES}
_MARKS: Final = tuple((f'"{mark}"'.encode(), kind) for mark, kind in _TYPE_OF_MARK.items())
_DECODERS: Final = {kind: msgspec.json.Decoder(kind) for kind in MESSAGE_TYPES}
_FIELDS: Final = {kind: msgspec.structs.fields(kind) for kind in MESSAGE_TYPES}
_FIELD_COUNTS: Final = {kind: len(fields) for kind, fields in _FIELDS.items()}
_NEW_CIDS: Final[dict[type[Any], bytes]] = {Demand: b'"objective":"', Offer: b'"objective":"', Result: b'"result":"'}
"""What stands before the CID of a message that no other message has."""
_FEW: Final = 8
"""Fewer CIDs are as fast one by one."""
_ANY_OBJECT: Final = msgspec.json.Decoder(dict[str, msgspec.Raw])
_ENCODER: Final = msgspec.json.Encoder()

_WORD: Final = 32
_ABI_HEAD: Final = 10 * _WORD
_MAX_UINT64: Final = 2**64 - 1
_SMALL_ORDER: Final = Struct(">34s34s20s24xQ20s20s24xQ24xQ")
"""What the hash of an order covers up to its nonce, if no number has more than 64 bits: in one step, so faster."""
_TWELVE_ZEROS: Final = bytes(12)
_WITHDRAWAL_TYPE: Final = keccak256(b"Withdrawal(bytes32 order,address lighthouse,uint256 deadline)")
"""The first word of what a withdrawal's signature covers; no order and no Result begins like this."""


def decode(payload: bytes, likely: type[Any] | None = None) -> Message:
    """The message in `payload`, checked and in canonical form; its signature is present, but not verified.

    It is decoded sooner if it is of the `likely` kind. Raises `InvalidMessage` and nothing else, whatever the bytes
    are. Its `reason` is one of `too-large`, `not-json`, `unknown-kind`, `unknown-field`, `duplicate-field`, `field`
    (missing or of the wrong type), `address`, `cid`, `nonce`, `range`, `hash`, `validator` (an order's lighthouse) and
    `signature`.
    """
    if len(payload) > MAX_MESSAGE_SIZE:
        raise InvalidMessage("too-large", f"it has {len(payload)} bytes; the limit is {MAX_MESSAGE_SIZE}")
    kind: type[Message] = likely or _type_of(payload)
    try:
        message = _DECODERS[kind].decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        if isinstance(error.__cause__, InvalidMessage):  # its fields are those of this kind, so it is of this kind
            raise error.__cause__ from None
        if likely is not None:
            return decode(payload)
        if isinstance(error, msgspec.ValidationError):
            _explain(payload, kind, str(error))
        raise InvalidMessage("not-json", str(error)) from None
    count = _FIELD_COUNTS[kind]
    # Not `isinstance`, which is slow when it fails.
    if (type(message) is Demand or type(message) is Offer) and message.sender is None:
        count -= 1
    if getattr(message, "signature", None) == "":
        _explain(payload, kind, "the signature is empty", reason="signature")
    # The decoder takes the last of repeated fields. No value of a well-formed message contains a colon, so there is
    # one colon per field; any more belong to repeated fields.
    if payload.count(b":") != count:
        _explain(payload, kind, "a field is repeated", reason="duplicate-field")
    return message


def parse_cids_ahead(payloads: Iterable[bytes], likely: type[Any]) -> None:
    """Parse together what is new in each payload, its CID: `decode` of those of the `likely` kind is faster then."""
    mark = _NEW_CIDS.get(likely)
    if mark is None:
        return
    starts = [(payload, payload.find(mark) + len(mark)) for payload in payloads]
    texts = [payload[start : start + CID_LENGTH] for payload, start in starts if start >= len(mark)]
    if len(texts) >= _FEW:
        parse_ahead([text.decode("ascii", "replace") for text in texts])


def encode(message: Message) -> bytes:
    """The compact JSON of a message, with exactly the fields that the legacy network knows.

    Raises `InvalidMessage` (`signature`) if the message should be signed and is not.
    """
    if not isinstance(message, TransactionFeedback) and not message.signature:
        raise InvalidMessage("signature", "the message is not signed; sign it before it travels")
    return _ENCODER.encode(message)


class MessageHash(bytes):
    """The 32 bytes of a message's hash, which print as hexadecimal digits."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.hex()

    __repr__ = __str__


def message_hash(message: Message) -> MessageHash:
    """The 32-byte hash that names a message and that its signature covers: keccak256 of the packed fields.

    Raises `InvalidMessage`: `unresolved-name` if an address is still an ENS name, `unsigned` for the feedback messages,
    for which no hash is defined.
    """
    pack = _PACKERS.get(type(message))
    if pack is None:
        raise InvalidMessage("unsigned", f"what is signed in a {type(message).__name__} is not defined")
    try:
        return MessageHash(keccak256(pack(message)))
    except InvalidAddress as error:
        raise _unresolved(error) from None


def cancellation_hash(liability: str) -> bytes:
    """The 32-byte hash that both parties sign to cancel the liability at this address, each with `Signer.sign_hash`.

    It is the keccak256 of the address and the six letters `cancel`: 26 bytes, a length that no message has. Raises
    `InvalidAddress`.
    """
    return keccak256(address_bytes(liability) + b"cancel")


def order_abi(order: Order) -> bytes:
    """The plain `abi.encode` of a signed order's fields: what `createLiability` takes for a demand or an offer.

    Generation 3 carries its nonce in the ninth place, generation 5 its sender, and contracts tell them apart by the
    twelve zero bytes before an address. Raises `InvalidMessage`: `signature` if the order is not signed,
    `unresolved-name`, or `nonce` if a generation-3 nonce would be taken for an address.
    """
    if not order.signature:
        raise InvalidMessage("signature", "the order is not signed")
    try:
        ninth = _ninth_word(order)
        parties = (address_bytes(order.lighthouse), address_bytes(order.validator))
        token = address_bytes(order.token)
    except InvalidAddress as error:
        raise _unresolved(error) from None
    fee = order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee
    first, second = parties if isinstance(order, Demand) else reversed(parties)
    contents = (parse_cid(order.model), parse_cid(order.objective), bytes.fromhex(order.signature))
    tails = [_abi_bytes(content) for content in contents]
    objective_at = _ABI_HEAD + len(tails[0])
    signature_at = objective_at + len(tails[1])
    head = (
        _word(_ABI_HEAD),
        _word(objective_at),
        _padded(token),
        _word(order.cost),
        _padded(first),
        _padded(second),
        _word(fee),
        _word(order.deadline),
        ninth,
        _word(signature_at),
    )
    return b"".join((*head, *tails))


def _type_of(payload: bytes) -> type[Message]:
    # No value of a well-formed message contains a quotation mark, so a mark that is found is a key. A writer may spell
    # keys with escapes; then none is found and the object is parsed.
    for mark, kind in _MARKS:
        if mark in payload:
            return kind
    present = _fields_of(payload)
    for field, kind in _TYPE_OF_MARK.items():
        if field in present:
            return kind
    raise InvalidMessage("unknown-kind", f"none of {', '.join(_TYPE_OF_MARK)} is present")


def _fields_of(payload: bytes) -> dict[str, msgspec.Raw]:
    try:
        return _ANY_OBJECT.decode(payload)
    except msgspec.ValidationError as error:
        raise InvalidMessage("unknown-kind", str(error)) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessage("not-json", str(error)) from None


def _explain(payload: bytes, kind: type[Message], detail: str, *, reason: str = "field") -> NoReturn:
    """Raise `InvalidMessage` with our own reason why `payload` is no message; not on the hot path."""
    present = _fields_of(payload)
    if "validatorFee" in present and "lighthouseFee" in present:
        raise InvalidMessage("unknown-kind", "it has both validatorFee and lighthouseFee")
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


def _pack_order(message: Order) -> bytes:
    first, second = address_bytes(message.lighthouse), address_bytes(message.validator)
    if isinstance(message, Demand):
        fee = message.validator_fee
    else:
        first, second, fee = second, first, message.lighthouse_fee
    if message.sender is None:
        tail = bytes.fromhex(message.nonce)  # type: ignore[arg-type]  # a text in generation 3
    else:
        tail = _word(message.nonce) + address_bytes(message.sender)  # type: ignore[arg-type]
    model, objective, token = parse_cid(message.model), parse_cid(message.objective), address_bytes(message.token)
    cost, deadline = message.cost, message.deadline
    if cost <= _MAX_UINT64 and fee <= _MAX_UINT64 and deadline <= _MAX_UINT64:
        return _SMALL_ORDER.pack(model, objective, token, cost, first, second, fee, deadline) + tail
    return b"".join((model, objective, token, _word(cost), first, second, _word(fee), _word(deadline), tail))


def _pack_result(message: Result) -> bytes:
    return address_bytes(message.liability) + parse_cid(message.result) + (b"\1" if message.success else b"\0")


def _pack_withdrawal(message: Withdrawal) -> bytes:
    lighthouse = _padded(address_bytes(message.lighthouse))
    return b"".join((_WITHDRAWAL_TYPE, bytes.fromhex(message.order), lighthouse, _word(message.deadline)))


_PACKERS: Final[dict[type[Message], Callable[[Any], bytes]]] = {
    Demand: _pack_order,
    Offer: _pack_order,
    Withdrawal: _pack_withdrawal,
    Result: _pack_result,
}
"""What the hash of a message covers, by its type; for the feedback messages it is not defined."""


def _ninth_word(order: Order) -> bytes:
    if order.sender is not None:
        return _padded(address_bytes(order.sender))
    nonce = bytes.fromhex(order.nonce)  # type: ignore[arg-type]  # a text in generation 3
    if nonce.startswith(_TWELVE_ZEROS):
        raise InvalidMessage("nonce", "twelve leading zero bytes would make a contract take the nonce for a sender")
    return nonce


def _word(value: int) -> bytes:
    return value.to_bytes(_WORD, "big")


def _padded(address: bytes) -> bytes:
    return _TWELVE_ZEROS + address


def _abi_bytes(data: bytes) -> bytes:
    return _word(len(data)) + data + bytes(-len(data) % _WORD)


def _unresolved(error: InvalidAddress) -> InvalidMessage:
    # An address field of a message holds an address or a name, so a text that is no address is a name.
    return InvalidMessage("unresolved-name", f"{error.text} has to be resolved to an address first")

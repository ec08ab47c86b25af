"""Hashes and contract bytes of messages: Solidity's `abi.encodePacked` and `abi.encode`, written out field by field."""

from __future__ import annotations

from schemas.address import address_bytes
from schemas.cid import parse_cid
from schemas.errors import InvalidAddress, InvalidMessage
from schemas.keccak import keccak256
from schemas.messages import Demand, Message, Offer, Order, Result

_WORD = 32
_ABI_HEAD = 10 * _WORD
_TWELVE_ZEROS = bytes(12)


def message_hash(message: Message) -> bytes:
    """The 32-byte hash that names a message and that its signature covers: keccak256 of the packed fields.

    Raises `InvalidMessage`: `unresolved-name` if an address is still an ENS name, `unsigned` for the feedback messages,
    for which no hash is defined.
    """
    try:
        return keccak256(_packed(message))
    except InvalidAddress as error:
        raise _unresolved(error) from None


def cancellation_hash(liability: str) -> bytes:
    """The 32-byte hash that both parties sign to call off the liability at this address, each with `Signer.sign_hash`.

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


def _packed(message: Message) -> bytes:
    if isinstance(message, Result):
        success = b"\1" if message.success else b"\0"
        return address_bytes(message.liability) + parse_cid(message.result) + success
    if not isinstance(message, (Demand, Offer)):
        raise InvalidMessage("unsigned", f"it is not defined what is signed in a {type(message).__name__}")
    lighthouse = address_bytes(message.lighthouse)
    validator = address_bytes(message.validator)
    if isinstance(message, Demand):
        parties, fee = lighthouse + validator, message.validator_fee
    else:
        parties, fee = validator + lighthouse, message.lighthouse_fee
    if message.sender is None:
        tail = bytes.fromhex(message.nonce)  # type: ignore[arg-type]  # a text in generation 3
    else:
        tail = message.nonce.to_bytes(_WORD, "big") + address_bytes(message.sender)  # type: ignore[union-attr]
    return b"".join(
        (
            parse_cid(message.model),
            parse_cid(message.objective),
            address_bytes(message.token),
            message.cost.to_bytes(_WORD, "big"),
            parties,
            fee.to_bytes(_WORD, "big"),
            message.deadline.to_bytes(_WORD, "big"),
            tail,
        )
    )


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
    # What stands in the address field of a message and is no address is a name.
    return InvalidMessage("unresolved-name", f"{error.text} has to be resolved to an address first")

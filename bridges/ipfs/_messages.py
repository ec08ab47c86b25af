"""Relayed messages: the same on both sides, validated, and in the JSON of legacy clients."""

from __future__ import annotations

import logging
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from mesh.base.log_context import log_event
from mesh.errors import InvalidMessage
from mesh.market.store import Withdrawals
from schemas import (
    Demand,
    Message,
    Offer,
    OrderFeedback,
    Result,
    address_bytes,
    decode,
    encode,
)
from schemas.keys import KINDS, market_key, market_kind

if TYPE_CHECKING:
    from collections.abc import Callable

    from mesh.network import MarketRules
    from schemas import Verified

log = logging.getLogger(__name__)

LARGEST_LEGACY: Final = 2**32 - 1
"""The largest amount or deadline that the legacy nodes of generation 3 can hold."""
_ENCODER: Final = msgspec.json.Encoder()
_LEGACY_FIELDS: Final[dict[tuple[type[Message], int], tuple[tuple[str, str], ...]]] = {}
"""Kind and generation → (attribute, field on the wire), in the order in which legacy clients wrote them."""


def _legacy_order(kind: type[Message], generation: int, names: str) -> None:
    attributes = {field.encode_name: field.name for field in msgspec.structs.fields(kind)}
    _LEGACY_FIELDS[kind, generation] = tuple((attributes[name], name) for name in names.split())


_legacy_order(Demand, 3, "model objective token cost validator lighthouse deadline nonce signature validatorFee")
_legacy_order(Offer, 3, "model objective token cost validator lighthouse deadline nonce signature lighthouseFee")
_legacy_order(Demand, 5, "model objective token cost lighthouse validator validatorFee deadline sender nonce signature")
_legacy_order(Offer, 5, "model objective token cost validator lighthouse lighthouseFee deadline sender nonce signature")
_legacy_order(Result, 0, "liability result success signature")
_legacy_order(OrderFeedback, 0, "order accepted signature")


def legacy_json(message: Message) -> bytes:
    """The JSON of a message byte for byte as legacy clients wrote it: compact, with the fields in their order.

    Readers should not depend on the order, but some may. Raises `InvalidMessage` (`signature`) for an unsigned message
    of a signed kind.
    """
    generation = message.generation if isinstance(message, Demand | Offer) else 0
    fields = _LEGACY_FIELDS.get((type(message), generation), (("tx", "tx"),))
    if not getattr(message, "signature", "transaction feedback is unsigned"):
        raise InvalidMessage("signature", "the message is not signed")
    return _ENCODER.encode({name: getattr(message, attribute) for attribute, name in fields})


class RelayMessage(NamedTuple):
    """A valid message. Its fingerprint is the same on both sides, whatever the encoding.

    `key` and `payload` are for the mesh, `legacy` is the JSON for IPFS. A signed message has a `hash` (64 hexadecimal
    digits) and a `signer` (EIP-55).
    """

    fingerprint: bytes
    key: str
    payload: bytes
    legacy: bytes
    hash: str = ""
    signer: str = ""

    @property
    def kind(self) -> str:
        """The kind in its key: demand, offer, result, feedback or pending."""
        return market_kind(self.key)

    @property
    def order(self) -> bytes:
        """The identity by which a withdrawal of this order is known."""
        return bytes.fromhex(self.hash) + address_bytes(self.signer) if self.signer else b""


class RelayValidator:
    """Validates the messages of one lighthouse by the `rules` of its market: `await validator.validate(payload)`.

    `withdrawals` are those known: their orders are not relayed. Without `large_numbers`, neither are orders of
    generation 3 from the mesh whose amounts or deadline have more than 32 bits: legacy nodes that meet one hear nothing
    more.
    """

    def __init__(
        self, rules: MarketRules, *, withdrawals: Withdrawals | None = None, large_numbers: bool = False
    ) -> None:
        self.rules: Final = rules
        self.withdrawals: Final = Withdrawals() if withdrawals is None else withdrawals
        self._large_numbers = large_numbers
        self.on_too_large: Callable[[Verified[Demand | Offer], str], None] = lambda order, why: None
        """Called with an order that has such numbers, and why it is rejected."""

    async def validate(self, payload: bytes, *, key: str | None = None) -> RelayMessage:
        """The message in `payload`: well-formed, for this market, before its deadline, correctly signed.

        `key`, if given, must be the one that the message requires. The signature of order feedback is not verified,
        because what it covers is undocumented. Raises only `InvalidMessage`; its `reason` is one of `schemas.decode`
        or `MarketRules.verified`, or `withdrawn`, `too-large`, and `kind` for a message that the legacy network does
        not have.
        """
        message = decode(payload)
        if not KINDS[message.kind].is_legacy:
            raise InvalidMessage("kind", f"the legacy network has no message of the kind {message.kind}")
        canonical = encode(message)
        own_key = market_key(self.rules.lighthouse, message.kind, message.key_model)
        digest = signer = ""
        if isinstance(message, Demand | Offer | Result):
            verified = await self.rules.verified(message, key)
            digest, signer = verified.hash.hex(), verified.signer
            if key is not None and not self._large_numbers:
                self._check_numbers(verified)
        elif key is not None and key != own_key:
            raise InvalidMessage("key", f"the message does not belong on {key}")
        fingerprint = sha256(canonical).digest()[:16]
        relayed = RelayMessage(fingerprint, own_key, canonical, legacy_json(message), digest, signer)
        if relayed.order in self.withdrawals:
            raise InvalidMessage("withdrawn", "its maker has withdrawn it")
        return relayed

    def _check_numbers(self, verified: Verified[Any]) -> None:
        """Raise `InvalidMessage` for an order that older legacy nodes can't hold; the log says whose it is."""
        order, signer = verified.message, verified.signer
        if not isinstance(order, Demand | Offer) or order.generation != 3:
            return
        fee = order.validator_fee if isinstance(order, Demand) else order.lighthouse_fee
        if max(order.cost, fee, order.deadline) > LARGEST_LEGACY:
            why = f"cost, fee and deadline are at most {LARGEST_LEGACY:,} on the legacy network of generation 3"
            too_large = log_event("order-too-large", signer=signer)
            log.warning("an order of %s is not passed on to IPFS: %s", signer, why, extra=too_large)
            self.on_too_large(verified, why)
            raise InvalidMessage("too-large", why)

"""The JSON that legacy clients put on the channel, to the byte: compact, and with the fields in their order. Pure.

A reader must not mind the order, but somebody's does: what leaves for IPFS is what was there before.
"""

from __future__ import annotations

from typing import Final

import msgspec

from schemas import Demand, InvalidMessage, Message, Offer, OrderFeedback, Result

_ENCODER: Final = msgspec.json.Encoder()

_FIELDS: Final[dict[tuple[type[Message], int], tuple[tuple[str, str], ...]]] = {}
"""Kind and generation → each field's name here and on the wire, in the order of the clients that the network had."""


def _order(kind: type[Message], generation: int, names: str) -> None:
    wire = {field.encode_name: field.name for field in msgspec.structs.fields(kind)}
    _FIELDS[kind, generation] = tuple((wire[name], name) for name in names.split())


_order(Demand, 3, "model objective token cost validator lighthouse deadline nonce signature validatorFee")
_order(Offer, 3, "model objective token cost validator lighthouse deadline nonce signature lighthouseFee")
_order(Demand, 5, "model objective token cost lighthouse validator validatorFee deadline sender nonce signature")
_order(Offer, 5, "model objective token cost validator lighthouse lighthouseFee deadline sender nonce signature")
_order(Result, 0, "liability result success signature")
_order(OrderFeedback, 0, "order accepted signature")


def legacy_json(message: Message) -> bytes:
    """The text of a message as a legacy client writes it.

    Raises `InvalidMessage` (`signature`) for one that should be signed and is not.
    """
    generation = message.generation if isinstance(message, Demand | Offer) else 0
    fields = _FIELDS.get((type(message), generation), (("tx", "tx"),))
    if not getattr(message, "signature", "a transaction feedback has none"):
        raise InvalidMessage("signature", "the message is not signed")
    return _ENCODER.encode({name: getattr(message, field) for field, name in fields})

"""Validation of relayed messages, and the JSON of legacy clients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from bridges.ipfs.validation import ChainAwaited, RelayValidator, legacy_json
from mesh.errors import InputError
from mesh.network import message_key
from schemas import InvalidMessage, OrderFeedback, TransactionFeedback, decode, encode, message_hash, resolve_names
from tests.support.orders import LIGHTHOUSE, MARKET, OTHER_MODEL, PERSON, STRANGER, TOKEN, demand, offer, result

if TYPE_CHECKING:
    from schemas import Message


OTHER = "other.lighthouse.3.robonomics.eth"
FEEDBACK = OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65)


async def resolve(name: str) -> str:
    known = {MARKET: LIGHTHOUSE, "xrt.3.robonomics.eth": TOKEN}
    if name not in known:
        raise InputError(f"{name} is not known")
    return known[name]


async def reason(validator: RelayValidator, payload: bytes, **options: Any) -> str:
    with pytest.raises(InvalidMessage) as caught:
        await validator.validate(payload, **options)
    return caught.value.reason


@pytest.mark.parametrize("message", [demand(), offer(), result()])
async def test_a_valid_message_is_the_same_in_both_encodings(message: Message) -> None:
    validator = RelayValidator(MARKET)
    from_ipfs = await validator.validate(legacy_json(message))
    from_mesh = await validator.validate(encode(message), key=from_ipfs.key)
    assert from_ipfs == from_mesh
    assert (from_ipfs.payload, from_ipfs.legacy) == (encode(message), legacy_json(message))
    assert from_ipfs.key == message_key(MARKET, message)  # type: ignore[arg-type]


async def test_feedback_has_one_key_of_each_kind() -> None:
    validator = RelayValidator(MARKET)
    key = f"aira/{MARKET}/feedback"
    assert (await validator.validate(encode(FEEDBACK), key=key)).key == key
    assert await reason(validator, encode(FEEDBACK), key=f"{key}/{'12' * 32}") == "key"
    assert (await validator.validate(encode(TransactionFeedback(tx="ab" * 32)))).key == f"aira/{MARKET}/pending"


async def test_a_signed_message_has_its_hash_and_feedback_has_none() -> None:
    validator, order = RelayValidator(MARKET), demand()
    assert (await validator.validate(encode(order))).hash == message_hash(order).hex()
    assert (await validator.validate(encode(FEEDBACK))).hash == ""


async def test_a_message_on_another_key_is_rejected() -> None:
    order = demand()
    assert (
        await reason(RelayValidator(MARKET), encode(order), key=message_key(MARKET, demand(model=OTHER_MODEL))) == "key"
    )
    assert (
        await reason(RelayValidator(MARKET), encode(order), key=message_key("other.lighthouse.3.robonomics.eth", order))
        == "key"
    )


async def test_an_order_of_another_market_or_past_its_deadline_is_rejected() -> None:
    validator = RelayValidator(MARKET, address=lambda: LIGHTHOUSE, head=lambda: 100)
    assert await reason(validator, encode(demand(lighthouse="0x" + "11" * 20))) == "lighthouse"
    assert await reason(validator, encode(demand(deadline=100))) == "deadline"
    await validator.validate(encode(demand(deadline=101)))
    await RelayValidator(MARKET).validate(encode(demand(deadline=0)))  # which block it is is not known


async def test_an_order_is_relayed_once_its_validator_is_known_to_be_safe() -> None:
    asked: list[str] = []

    async def is_safe(validator: str) -> bool:
        asked.append(validator)
        if validator == STRANGER.address:
            raise ChainAwaited("the node was not reached yet")
        return validator == TOKEN

    validator = RelayValidator(MARKET, is_safe=is_safe)
    await validator.validate(encode(demand()))
    forged = replace(demand(validator=PERSON.address), signature="00" * 65)
    assert await reason(validator, encode(forged)) == "signature"
    assert asked == []
    await validator.validate(encode(demand(validator=TOKEN)))
    for make in (demand, offer):
        assert await reason(validator, encode(make(validator=PERSON.address))) == "validator"
        assert await reason(validator, legacy_json(make(validator=STRANGER.address))) == "validator"


async def test_a_forged_signature_is_rejected() -> None:
    sender: dict[str, Any] = {"nonce": 1, "sender": PERSON.address}
    await RelayValidator(MARKET).validate(encode(demand(**sender)))
    forged = replace(demand(**sender), signature=demand(signer=STRANGER).signature)
    assert await reason(RelayValidator(MARKET), encode(forged)) == "sender"
    assert await reason(RelayValidator(MARKET), encode(replace(demand(), signature="00" * 65))) == "signature"


async def test_names_are_resolved_for_validation_and_kept_in_the_encodings() -> None:
    named = {"lighthouse": MARKET, "token": "xrt.3.robonomics.eth"}
    order = replace(demand(), **named)
    signed = PERSON.sign(resolve_names(order, {MARKET: LIGHTHOUSE, named["token"]: TOKEN}))
    order = replace(signed, **named)
    message = await RelayValidator(MARKET, address=lambda: LIGHTHOUSE, resolver=resolve).validate(legacy_json(order))
    assert message.key == message_key(MARKET, signed)
    assert MARKET.encode() in message.payload
    assert MARKET.encode() in message.legacy
    assert await reason(RelayValidator(MARKET), legacy_json(order)) == "name"
    unknown = replace(order, token="nobody.eth")
    assert await reason(RelayValidator(MARKET, resolver=resolve), legacy_json(unknown)) == "name"


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b"{}", b"null", b'{"tx":1}', b"x" * 100_000])
async def test_invalid_input_is_rejected_with_a_reason(payload: bytes) -> None:
    assert await reason(RelayValidator(MARKET), payload) in {"not-json", "unknown-kind", "field", "too-large", "hash"}


VECTORS = Path(__file__).parents[2] / "schemas" / "vectors"
WIRES = [
    vector["wire"]
    for generation in (3, 5)
    for vector in json.loads((VECTORS / f"messages-generation-{generation}.json").read_text())
]


@pytest.mark.parametrize("wire", WIRES)
def test_legacy_json_is_byte_for_byte_that_of_legacy_clients(wire: str) -> None:
    assert legacy_json(decode(wire.encode())).decode() == wire


def test_feedback_fields_are_in_their_documented_order() -> None:
    order = OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65)
    assert legacy_json(order).decode() == f'{{"order":"{"ab" * 32}","accepted":1,"signature":"{"cd" * 65}"}}'
    assert legacy_json(TransactionFeedback(tx="ab" * 32)).decode() == f'{{"tx":"{"ab" * 32}"}}'


def test_an_unsigned_message_has_no_legacy_json() -> None:
    with pytest.raises(InvalidMessage) as caught:
        legacy_json(replace(demand(), signature=""))
    assert caught.value.reason == "signature"

"""Validation of relayed messages, and the JSON of legacy clients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from bridges.ipfs._relay import RelayValidator, legacy_json
from mesh.errors import ChainError, InputError
from mesh.network import MarketRules, message_key
from schemas import (
    InvalidMessage,
    OrderFeedback,
    Permit,
    TransactionFeedback,
    Withdrawal,
    decode,
    encode,
    message_hash,
    resolve_names,
)
from schemas.keys import KINDS
from schemas.messages import MESSAGE_TYPES
from tests.support.orders import (
    CONTRACT,
    LIGHTHOUSE,
    MARKET,
    OTHER_MODEL,
    PERSON,
    STRANGER,
    TOKEN,
    demand,
    offer,
    result,
)

if TYPE_CHECKING:
    from schemas import Message


OTHER = "other.lighthouse.3.robonomics.eth"
FEEDBACK = OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65)


async def resolve(name: str) -> str:
    known = {MARKET: LIGHTHOUSE, "xrt.3.robonomics.eth": TOKEN}
    if name not in known:
        raise InputError(f"{name} is not known")
    return known[name]


def validating() -> RelayValidator:
    return RelayValidator(MarketRules(MARKET))


async def reason(validator: RelayValidator, payload: bytes, **options: Any) -> str:
    with pytest.raises(InvalidMessage) as caught:
        await validator.validate(payload, **options)
    return caught.value.reason


@pytest.mark.parametrize("message", [demand(), offer(), result()])
async def test_a_valid_message_is_the_same_in_both_encodings(message: Message) -> None:
    validator = validating()
    from_ipfs = await validator.validate(legacy_json(message))
    from_mesh = await validator.validate(encode(message), key=from_ipfs.key)
    assert from_ipfs == from_mesh
    assert (from_ipfs.payload, from_ipfs.legacy) == (encode(message), legacy_json(message))
    assert from_ipfs.key == message_key(MARKET, message)  # type: ignore[arg-type]


async def test_of_all_kinds_only_those_of_the_legacy_network_are_relayed() -> None:
    withdrawal = Withdrawal(order="ab" * 32, lighthouse=LIGHTHOUSE, deadline=2**30)
    addresses = {"owner": PERSON.address, "spender": CONTRACT, "token": TOKEN}
    permit = Permit(**addresses, value=1, nonce=0, deadline=2**40, domain="11" * 32)
    signed = (PERSON.sign(withdrawal), PERSON.sign(permit), demand(), offer(), result())
    messages = (*signed, FEEDBACK, TransactionFeedback(tx="ab" * 32))
    assert {type(message) for message in messages} == set(MESSAGE_TYPES)
    for message in messages:
        if KINDS[message.kind].is_legacy:
            await validating().validate(encode(message))
        else:
            assert await reason(validating(), encode(message)) == "kind"


async def test_feedback_has_one_key_of_each_kind() -> None:
    validator = validating()
    key = f"aira/{MARKET}/feedback"
    assert (await validator.validate(encode(FEEDBACK), key=key)).key == key
    assert await reason(validator, encode(FEEDBACK), key=f"{key}/{'12' * 32}") == "key"
    assert (await validator.validate(encode(TransactionFeedback(tx="ab" * 32)))).key == f"aira/{MARKET}/pending"


async def test_a_signed_message_has_its_hash_and_signer_and_feedback_has_none() -> None:
    validator, order = validating(), demand()
    signed = await validator.validate(encode(order))
    assert (signed.hash, signed.signer) == (message_hash(order).hex(), PERSON.address)
    feedback = await validator.validate(encode(FEEDBACK))
    assert feedback.hash == feedback.signer == ""


async def test_a_message_on_another_key_is_rejected() -> None:
    order = demand()
    assert await reason(validating(), encode(order), key=message_key(MARKET, demand(model=OTHER_MODEL))) == "key"
    assert (
        await reason(
            validating(),
            encode(order),
            key=message_key("other.lighthouse.3.robonomics.eth", order),
        )
        == "key"
    )


async def test_an_order_of_another_market_or_past_its_deadline_is_rejected() -> None:
    validator = RelayValidator(MarketRules(MARKET, address=LIGHTHOUSE, head=lambda: 100))
    assert await reason(validator, encode(demand(lighthouse="0x" + "11" * 20))) == "lighthouse"
    assert await reason(validator, encode(demand(deadline=100))) == "deadline"
    await validator.validate(encode(demand(deadline=101)))
    await validating().validate(encode(demand(deadline=0)))  # which block it is is not known


async def test_an_order_is_relayed_once_its_validator_is_known_to_be_safe() -> None:
    asked: list[str] = []

    class Asked:
        def known(self, validator: str) -> bool | None:
            return None

        async def is_safe(self, validator: str) -> bool:
            asked.append(validator)
            if validator == STRANGER.address:
                raise ChainError("the node was not reached yet")
            return validator == TOKEN

    validator = RelayValidator(MarketRules(MARKET, validators=Asked()))
    await validator.validate(encode(demand()))
    forged = replace(demand(validator=PERSON.address), signature="00" * 65)
    assert await reason(validator, encode(forged)) == "signature"
    assert asked == []
    await validator.validate(encode(demand(validator=TOKEN)))
    for make in (demand, offer):
        assert await reason(validator, encode(make(validator=PERSON.address))) == "validator"
        assert await reason(validator, legacy_json(make(validator=STRANGER.address))) == "validator"


async def test_the_rules_of_the_market_hold_for_what_comes_from_ipfs() -> None:
    blocking = RelayValidator(MarketRules(MARKET, blocked=frozenset({PERSON.address})))
    assert await reason(blocking, legacy_json(demand())) == "blocked"
    await blocking.validate(legacy_json(demand(signer=STRANGER)))
    assert await reason(validating(), legacy_json(demand(nonce="00" * 12 + "12" * 20))) == "nonce"


async def test_a_forged_signature_is_rejected() -> None:
    sender: dict[str, Any] = {"nonce": 1, "sender": PERSON.address}
    await validating().validate(encode(demand(**sender)))
    forged = replace(demand(**sender), signature=demand(signer=STRANGER).signature)
    assert await reason(validating(), encode(forged)) == "sender"
    assert await reason(validating(), encode(replace(demand(), signature="00" * 65))) == "signature"


async def test_names_are_resolved_for_validation_and_kept_in_the_encodings() -> None:
    named = {"lighthouse": MARKET, "token": "xrt.3.robonomics.eth"}
    order = replace(demand(), **named)
    signed = PERSON.sign(resolve_names(order, {MARKET: LIGHTHOUSE, named["token"]: TOKEN}))
    order = replace(signed, **named)
    message = await RelayValidator(MarketRules(MARKET, address=LIGHTHOUSE, resolver=resolve)).validate(
        legacy_json(order)
    )
    assert message.key == message_key(MARKET, signed)
    assert MARKET.encode() in message.payload
    assert MARKET.encode() in message.legacy
    assert await reason(validating(), legacy_json(order)) == "name"
    unknown = replace(order, token="nobody.eth")
    assert await reason(RelayValidator(MarketRules(MARKET, resolver=resolve)), legacy_json(unknown)) == "name"


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b"{}", b"null", b'{"tx":1}', b"x" * 100_000])
async def test_invalid_input_is_rejected_with_a_reason(payload: bytes) -> None:
    assert await reason(validating(), payload) in {
        "not-json",
        "unknown-kind",
        "field",
        "too-large",
        "hash",
    }


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


@pytest.mark.parametrize("fields", [{"cost": 2**32}, {"deadline": 2**32}, {"validator_fee": 2**32}])
async def test_numbers_that_make_legacy_nodes_deaf_are_not_passed_to_them(
    fields: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    order = demand(**fields)
    key, payload = message_key(MARKET, order), encode(order)
    assert await reason(validating(), payload, key=key) == "too-large"
    assert PERSON.address in caplog.text
    await RelayValidator(MarketRules(MARKET), large_numbers=True).validate(payload, key=key)
    await validating().validate(payload)  # from IPFS: they have it already
    most: dict[str, Any] = dict.fromkeys(fields, 2**32 - 1)
    largest = demand(**most)
    await validating().validate(encode(largest), key=key)

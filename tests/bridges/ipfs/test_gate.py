from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace

from bridges.ipfs.gate import Gate
from bridges.ipfs.writing import legacy_json
from mesh.errors import InputError
from mesh.network import message_key
from schemas import FeedbackKey, InvalidMessage, OrderFeedback, TransactionFeedback, encode, resolve_names
from tests.support.orders import LIGHTHOUSE, MARKET, PERSON, STRANGER, TOKEN, demand, offer, result

if TYPE_CHECKING:
    from schemas import Message

OTHER = "other.lighthouse.3.robonomics.eth"
FEEDBACK = OrderFeedback(order="ab" * 32, accepted=1, signature="cd" * 65)


async def resolve(name: str) -> str:
    known = {MARKET: LIGHTHOUSE, "xrt.3.robonomics.eth": TOKEN}
    if name not in known:
        raise InputError(f"{name} is not known")
    return known[name]


async def reason(gate: Gate, payload: bytes, **options: Any) -> str:
    with pytest.raises(InvalidMessage) as refused:
        await gate.admit(payload, **options)
    return refused.value.reason


@pytest.mark.parametrize("message", [demand(), offer(), result()])
async def test_a_good_message_passes_in_both_writings_and_is_known_again(message: Message) -> None:
    gate = Gate(MARKET)
    from_ipfs = await gate.admit(legacy_json(message))
    from_mesh = await gate.admit(encode(message), key=from_ipfs.key)
    assert from_ipfs == from_mesh
    assert (from_ipfs.payload, from_ipfs.legacy) == (encode(message), legacy_json(message))
    assert from_ipfs.key == message_key(MARKET, message)  # type: ignore[arg-type]


async def test_feedback_has_a_key_of_its_own_or_the_one_by_which_it_came() -> None:
    gate = Gate(MARKET)
    own, other = (await gate.admit(encode(FEEDBACK))).key, str(FeedbackKey(MARKET, "ab" * 32, "12" * 32))
    assert own.rpartition("/")[0] == other.rpartition("/")[0]
    assert (await gate.admit(encode(FEEDBACK), key=other)).key == other
    assert await reason(gate, encode(FEEDBACK), key=str(FeedbackKey(MARKET, "ef" * 32, "12" * 32))) == "key"
    assert (await gate.admit(encode(TransactionFeedback(tx="ab" * 32)))).key == f"aira/{MARKET}/pending/{'ab' * 32}"


async def test_a_message_belongs_on_its_own_key_only() -> None:
    order = demand()
    assert await reason(Gate(MARKET), encode(order), key=message_key(MARKET, demand())) == "key"
    assert (
        await reason(Gate(MARKET), encode(order), key=message_key("other.lighthouse.3.robonomics.eth", order)) == "key"
    )


async def test_an_order_of_another_market_or_of_the_past_does_not_pass() -> None:
    gate = Gate(MARKET, address=lambda: LIGHTHOUSE, head=lambda: 100)
    assert await reason(gate, encode(demand(lighthouse="0x" + "11" * 20))) == "lighthouse"
    assert await reason(gate, encode(demand(deadline=100))) == "deadline"
    await gate.admit(encode(demand(deadline=101)))


async def test_what_another_has_signed_does_not_pass_as_its_senders() -> None:
    sender: dict[str, Any] = {"nonce": 1, "sender": PERSON.address}
    await Gate(MARKET).admit(encode(demand(**sender)))
    forged = replace(demand(**sender), signature=demand(signer=STRANGER).signature)
    assert await reason(Gate(MARKET), encode(forged)) == "sender"
    assert await reason(Gate(MARKET), encode(replace(demand(), signature="00" * 65))) == "signature"


async def test_names_are_looked_up_where_somebody_can_and_stay_in_what_is_written() -> None:
    named = {"lighthouse": MARKET, "token": "xrt.3.robonomics.eth"}
    order = replace(demand(), **named)
    signed = PERSON.sign(resolve_names(order, {MARKET: LIGHTHOUSE, named["token"]: TOKEN}))
    order = replace(signed, **named)
    passenger = await Gate(MARKET, address=lambda: LIGHTHOUSE, resolver=resolve).admit(legacy_json(order))
    assert passenger.key == message_key(MARKET, signed)
    assert MARKET.encode() in passenger.payload
    assert MARKET.encode() in passenger.legacy
    assert await reason(Gate(MARKET), legacy_json(order)) == "name"
    unknown = replace(order, token="nobody.eth")
    assert await reason(Gate(MARKET, resolver=resolve), legacy_json(unknown)) == "name"


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b"{}", b"null", b'{"tx":1}', b"x" * 100_000])
async def test_rubbish_of_any_kind_is_refused_with_a_reason(payload: bytes) -> None:
    assert await reason(Gate(MARKET), payload) in {"not-json", "unknown-kind", "field", "too-large", "hash"}

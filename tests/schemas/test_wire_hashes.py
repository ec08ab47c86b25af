"""Hashes and contract bytes, against an independent implementation of Solidity's encodings."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from eth_abi.abi import encode
from eth_abi.packed import encode_packed
from hypothesis import given

from schemas import (
    Demand,
    InvalidAddress,
    InvalidMessage,
    Offer,
    Order,
    OrderFeedback,
    Result,
    TransactionFeedback,
    Withdrawal,
    address_bytes,
    cancellation_hash,
    keccak256,
    message_hash,
    order_abi,
    parse_cid,
)
from tests.support.schemas.samples import DEMAND, DEMAND_5, LIGHTHOUSE_NAME, NONCE, OFFER, RESULT, SIGNATURE
from tests.support.schemas.strategies import addresses, orders, results, withdrawals


def typed_terms(order: Order) -> list[tuple[str, Any]]:
    """The fields before nonce and sender with their Solidity types, in the order of the wire format's description."""
    lighthouse = ("address", address_bytes(order.lighthouse))
    validator = ("address", address_bytes(order.validator))
    if isinstance(order, Demand):
        parties, fee = [lighthouse, validator], order.validator_fee
    else:
        parties, fee = [validator, lighthouse], order.lighthouse_fee
    return [
        ("bytes", parse_cid(order.model)),
        ("bytes", parse_cid(order.objective)),
        ("address", address_bytes(order.token)),
        ("uint256", order.cost),
        *parties,
        ("uint256", fee),
        ("uint256", order.deadline),
    ]


def tail(order: Order) -> list[tuple[str, Any]]:
    if order.sender is None:
        return [("bytes32", bytes.fromhex(str(order.nonce)))]
    return [("uint256", order.nonce), ("address", address_bytes(order.sender))]


@given(orders(addresses))
def test_hash_of_an_order_is_that_of_its_packed_fields(order: Order) -> None:
    types, values = zip(*typed_terms(order), *tail(order), strict=True)
    assert message_hash(order) == keccak256(encode_packed(types, values))


@given(results(addresses))
def test_hash_of_a_result_is_that_of_its_packed_fields(result: Result) -> None:
    values = (address_bytes(result.liability), parse_cid(result.result), result.success)
    assert message_hash(result) == keccak256(encode_packed(("address", "bytes", "bool"), values))


@given(orders(addresses))
def test_contract_bytes_are_the_plain_abi_encoding(order: Order) -> None:
    fields = [*typed_terms(order), tail(order)[-1], ("bytes", bytes.fromhex(order.signature))]
    types, values = zip(*fields, strict=True)
    if order.sender is None and str(order.nonce).startswith("00" * 12):
        return
    assert order_abi(order) == encode(types, values)


def test_hash_does_not_depend_on_the_signature() -> None:
    assert message_hash(DEMAND) == message_hash(msgspec.structs.replace(DEMAND, signature=""))


def test_demand_and_offer_of_equal_terms_have_different_hashes() -> None:
    assert len({message_hash(message) for message in (DEMAND, OFFER, DEMAND_5, RESULT)}) == 4


@pytest.mark.parametrize("field", ["token", "lighthouse", "validator"])
@pytest.mark.parametrize("order", [DEMAND, OFFER])
def test_a_name_must_be_resolved_first(order: Demand | Offer, field: str) -> None:
    named = msgspec.structs.replace(order, **{field: LIGHTHOUSE_NAME})
    for function in (message_hash, order_abi):
        with pytest.raises(InvalidMessage) as caught:
            function(named)
        assert caught.value.reason == "unresolved-name"
        assert LIGHTHOUSE_NAME in caught.value.detail


def test_a_named_sender_or_liability_must_be_resolved_first() -> None:
    for named in (
        msgspec.structs.replace(DEMAND_5, sender="robot.eth"),
        msgspec.structs.replace(RESULT, liability="robot.eth"),
    ):
        with pytest.raises(InvalidMessage) as caught:
            message_hash(named)
        assert "robot.eth" in caught.value.detail
        assert caught.value.reason == "unresolved-name"


@given(withdrawals(addresses))
def test_hash_of_a_withdrawal_is_that_of_its_type_and_encoded_fields(withdrawal: Withdrawal) -> None:
    kind = keccak256(b"Withdrawal(bytes32 order,address lighthouse,uint256 deadline)")
    values = (kind, bytes.fromhex(withdrawal.order), withdrawal.lighthouse, withdrawal.deadline)
    assert message_hash(withdrawal) == keccak256(encode(["bytes32", "bytes32", "address", "uint256"], values))


@given(withdrawals(addresses), orders(addresses) | results(addresses))
def test_a_withdrawal_is_no_other_message_under_any_reading(withdrawal: Withdrawal, other: Order | Result) -> None:
    """Contracts take texts of any length for a CID. An order's other fields alone are longer than a withdrawal; a
    Result of that length would have to name a liability whose address is the beginning of a hash."""
    shortest_order = [kind for kind, _ in (*typed_terms(DEMAND), *tail(DEMAND)) if kind != "bytes"]
    sizes = {"address": 20, "uint256": 32, "bytes32": 32}
    covered = encode(
        ["bytes32", "bytes32", "address", "uint256"],
        [bytes(32), bytes.fromhex(withdrawal.order), withdrawal.lighthouse, withdrawal.deadline],
    )
    assert len(covered) == 128 < sum(sizes[kind] for kind in shortest_order)
    assert message_hash(withdrawal) != message_hash(other)
    assert message_hash(withdrawal) != cancellation_hash(withdrawal.lighthouse)


def test_feedback_has_no_hash() -> None:
    for feedback in (OrderFeedback(order=NONCE, accepted=1, signature=SIGNATURE), TransactionFeedback(tx=NONCE)):
        with pytest.raises(InvalidMessage) as caught:
            message_hash(feedback)
        assert caught.value.reason == "unsigned"


def test_unsigned_order_has_no_contract_bytes() -> None:
    with pytest.raises(InvalidMessage) as caught:
        order_abi(msgspec.structs.replace(DEMAND, signature=""))
    assert caught.value.reason == "signature"


def test_nonce_that_looks_like_a_sender_has_no_contract_bytes() -> None:
    with pytest.raises(InvalidMessage) as caught:
        order_abi(msgspec.structs.replace(DEMAND, nonce="00" * 12 + "11" * 20))
    assert caught.value.reason == "nonce"
    assert order_abi(msgspec.structs.replace(DEMAND, nonce="00" * 11 + "11" * 21))


@given(addresses)
def test_a_cancellation_hashes_the_address_and_the_word(address: str) -> None:
    assert cancellation_hash(address) == keccak256(encode_packed(["address", "string"], [address, "cancel"]))


def test_only_an_address_can_be_cancelled() -> None:
    with pytest.raises(InvalidAddress):
        cancellation_hash(LIGHTHOUSE_NAME)

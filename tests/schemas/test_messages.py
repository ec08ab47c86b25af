"""Every message object is well-formed and in canonical form; ENS names in messages."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given
from msgspec.structs import replace

from schemas import (
    MAX_UINT256,
    Demand,
    InvalidAddress,
    InvalidMessage,
    Message,
    Offer,
    OrderFeedback,
    Result,
    TransactionFeedback,
    checksum_address,
    decode,
    keccak256,
    message_hash,
    names_in,
    resolve_names,
)
from tests.support.schemas.samples import (
    DEMAND,
    DEMAND_5,
    DEMAND_JSON,
    LIGHTHOUSE,
    LIGHTHOUSE_NAME,
    MODEL,
    NONCE,
    OFFER,
    OFFER_5,
    RESULT,
    SENDER,
    SIGNATURE,
    TERMS,
    TOKEN,
    WITHDRAWAL,
    payload,
)
from tests.support.schemas.strategies import messages


def demand(**changes: Any) -> Demand:
    return Demand(**{**TERMS, "validator_fee": 7, **changes})


def refused(**changes: Any) -> InvalidMessage:
    with pytest.raises(InvalidMessage) as caught:
        demand(**changes)
    return caught.value


def test_the_sender_determines_the_generation() -> None:
    assert [order.generation for order in (DEMAND, OFFER, DEMAND_5, OFFER_5)] == [3, 3, 5, 5]


def test_messages_are_frozen_and_equal_by_value() -> None:
    with pytest.raises(AttributeError):
        DEMAND.cost = 1  # type: ignore[misc]
    assert demand() == DEMAND
    assert len({demand(), DEMAND, OFFER}) == 2


@pytest.mark.parametrize("text", [TOKEN.lower(), "0x" + TOKEN[2:].upper(), TOKEN])
def test_addresses_are_held_in_eip_55_form(text: str) -> None:
    held = demand(token=text, lighthouse=text), demand(validator=text)
    assert (held[0].token, held[0].lighthouse, held[1].validator) == (TOKEN, TOKEN, TOKEN)


def test_ens_names_are_held_in_lower_case() -> None:
    held = demand(lighthouse=LIGHTHOUSE_NAME.upper(), token="XRT.3.robonomics.eth")
    assert (held.lighthouse, held.token) == (LIGHTHOUSE_NAME, "xrt.3.robonomics.eth")


def test_sender_is_an_address_or_a_name_too() -> None:
    assert demand(sender=SENDER.lower(), nonce=0).sender == SENDER
    assert demand(sender="Robot.Eth", nonce=0).sender == "robot.eth"
    assert refused(sender="robot", nonce=0).reason == "address"


@pytest.mark.parametrize("text", [NONCE, NONCE.upper(), "0x" + NONCE, "0x" + NONCE.upper()])
def test_nonce_of_generation_3_is_held_as_lower_case_digits(text: str) -> None:
    assert demand(nonce=text).nonce == NONCE


@pytest.mark.parametrize(
    "nonce",
    [
        NONCE[:-1],
        NONCE + "0",
        "0x" + NONCE[2:],
        "",
        " " + NONCE[1:],
        NONCE[:-2] + "  ",
        "g" + NONCE[1:],
        "é" * 64,
        5,
        None,
    ],
)
def test_nonce_of_generation_3_is_64_digits(nonce: object) -> None:
    assert refused(nonce=nonce).reason == "nonce"


@pytest.mark.parametrize(("nonce", "reason"), [(NONCE, "nonce"), (True, "nonce"), (-1, "range"), (2**256, "range")])
def test_nonce_of_generation_5_is_an_integer(nonce: object, reason: str) -> None:
    assert refused(sender=SENDER, nonce=nonce).reason == reason


@pytest.mark.parametrize("text", [SIGNATURE, SIGNATURE.upper(), "0x" + SIGNATURE])
def test_signature_is_held_as_lower_case_digits(text: str) -> None:
    assert demand(signature=text).signature == SIGNATURE


@pytest.mark.parametrize("text", [SIGNATURE[:-2], SIGNATURE + "00", "0X" + SIGNATURE, "0x", "zz" + SIGNATURE[2:]])
def test_signature_is_65_bytes(text: str) -> None:
    assert refused(signature=text).reason == "signature"


@pytest.mark.parametrize("field", ["cost", "deadline", "validator_fee"])
def test_amounts_have_256_bits(field: str) -> None:
    assert getattr(demand(**{field: MAX_UINT256}), field) == MAX_UINT256
    for value, reason in ((MAX_UINT256 + 1, "range"), (-1, "range"), (True, "field"), (1.0, "field"), ("1", "field")):
        assert refused(**{field: value}).reason == reason


def test_fee_of_an_offer_has_256_bits() -> None:
    with pytest.raises(InvalidMessage) as caught:
        Offer(**TERMS, lighthouse_fee=-1)
    assert "lighthouseFee" in caught.value.detail
    assert caught.value.reason == "range"


@pytest.mark.parametrize("field", ["model", "objective"])
def test_cids_are_checked_and_the_field_is_named(field: str) -> None:
    error = refused(**{field: MODEL[:-1]})
    assert error.reason == "cid"
    assert field in error.detail


@pytest.mark.parametrize("field", ["token", "lighthouse", "validator"])
def test_addresses_are_checked_and_the_field_is_named(field: str) -> None:
    swapped = LIGHTHOUSE.swapcase().replace("0X", "0x")
    for text in (swapped, LIGHTHOUSE[2:], LIGHTHOUSE + "0", "robot.com", ".eth", ""):
        error = refused(**{field: text})
        assert error.reason == "address"
        assert field in error.detail


def test_result_is_checked() -> None:
    good: dict[str, Any] = {"liability": LIGHTHOUSE.lower(), "result": MODEL, "success": False}
    assert Result(**good).liability == LIGHTHOUSE
    for field, value, reason in (
        ("liability", "0x", "address"),
        ("result", "", "cid"),
        ("success", 1, "field"),
        ("signature", "1b", "signature"),
    ):
        with pytest.raises(InvalidMessage) as caught:
            Result(**{**good, field: value})
        assert caught.value.reason == reason


def test_withdrawal_is_checked() -> None:
    assert msgspec.structs.replace(WITHDRAWAL, order="0x" + NONCE.upper()) == WITHDRAWAL
    assert names_in(msgspec.structs.replace(WITHDRAWAL, lighthouse=LIGHTHOUSE_NAME.upper())) == {LIGHTHOUSE_NAME}
    for field, value, reason in (
        ("order", NONCE[2:], "hash"),
        ("lighthouse", "", "address"),
        ("deadline", -1, "range"),
        ("signature", "1b", "signature"),
    ):
        with pytest.raises(InvalidMessage) as caught:
            msgspec.structs.replace(WITHDRAWAL, **{field: value})
        assert caught.value.reason == reason


def test_feedback_is_checked() -> None:
    assert OrderFeedback(order="0x" + NONCE.upper(), accepted=1, signature=SIGNATURE).order == NONCE
    assert TransactionFeedback(tx="0x" + NONCE).tx == NONCE
    for order, accepted, signature, reason in (
        (NONCE[2:], 1, SIGNATURE, "hash"),
        (NONCE, -1, SIGNATURE, "range"),
        (NONCE, 1, "00", "signature"),
    ):
        with pytest.raises(InvalidMessage) as caught:
            OrderFeedback(order=order, accepted=accepted, signature=signature)
        assert caught.value.reason == reason


def test_a_replaced_field_is_checked_as_well() -> None:
    with pytest.raises(InvalidMessage):
        msgspec.structs.replace(DEMAND, cost=-1)


def test_message_with_addresses_only_has_no_names() -> None:
    feedback = (OrderFeedback(order=NONCE, accepted=1, signature=SIGNATURE), TransactionFeedback(tx=NONCE))
    for message in (DEMAND, DEMAND_5, WITHDRAWAL, RESULT, *feedback):
        assert names_in(message) == frozenset()


def test_names_are_found_in_every_address_field() -> None:
    changes = {field: f"{field}.eth" for field in ("token", "lighthouse", "validator", "sender")}
    assert names_in(msgspec.structs.replace(DEMAND_5, **changes)) == set(changes.values())
    assert names_in(msgspec.structs.replace(RESULT, liability="l.test")) == {"l.test"}


def test_resolved_message_is_the_one_with_addresses() -> None:
    named = decode(payload(DEMAND_JSON, lighthouse=LIGHTHOUSE_NAME.upper(), token="xrt.sid"))
    resolved = resolve_names(named, {LIGHTHOUSE_NAME: LIGHTHOUSE.lower(), "xrt.sid": TOKEN, "other.eth": SENDER})
    assert resolved == DEMAND
    assert message_hash(resolved) == message_hash(DEMAND)


def test_one_name_in_several_places_is_resolved_in_all() -> None:
    named = msgspec.structs.replace(DEMAND_5, sender="me.eth", validator="me.eth")
    assert resolve_names(named, {"me.eth": SENDER}) == msgspec.structs.replace(DEMAND_5, validator=SENDER)


def test_unknown_name_is_refused() -> None:
    named = msgspec.structs.replace(RESULT, liability="nobody.eth")
    with pytest.raises(InvalidMessage) as caught:
        resolve_names(named, {})
    assert "nobody.eth" in caught.value.detail
    assert caught.value.reason == "unresolved-name"


def test_name_that_maps_to_no_address_is_refused() -> None:
    named = msgspec.structs.replace(RESULT, liability="nobody.eth")
    with pytest.raises(InvalidAddress):
        resolve_names(named, {"nobody.eth": "somewhere"})


@pytest.mark.parametrize(
    "order", [DEMAND, OFFER, DEMAND_5, OFFER_5], ids=lambda order: f"{order.kind} {order.generation}"
)
def test_a_lighthouse_is_not_its_own_validator(order: Demand | Offer) -> None:
    for validator in (LIGHTHOUSE, LIGHTHOUSE.lower()):
        with pytest.raises(InvalidMessage) as caught:
            replace(order, validator=validator)
        assert caught.value.reason == "validator"
    named = replace(order, lighthouse=LIGHTHOUSE_NAME, validator="lamp.eth")
    with pytest.raises(InvalidMessage) as caught:
        resolve_names(named, {LIGHTHOUSE_NAME: LIGHTHOUSE, "lamp.eth": LIGHTHOUSE})
    assert caught.value.reason == "validator"


@given(messages())
def test_a_resolved_message_has_no_names(message: Message) -> None:
    addresses = {name: checksum_address(keccak256(name.encode())[:20]) for name in names_in(message)}
    assert names_in(resolve_names(message, addresses)) == frozenset()

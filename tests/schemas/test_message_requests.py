"""Requests to sign a message, and to publish a signed one."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from msgspec.structs import asdict, replace

from schemas import Demand, InvalidMessage, InvalidRecord, Offer, Order, Result
from schemas.rpc import (
    GUARDED,
    SERVICES,
    SPENDING,
    PermitFeeRequest,
    SendDemand,
    SendOffer,
    SendResult,
    SignDemand,
    SignOffer,
    SignResult,
)
from tests.support.schemas.samples import DEMAND, DEMAND_5, OFFER, RESULT
from tests.support.schemas.strategies import addresses, orders, results


def request_of(message: Demand | Offer | Result) -> SendDemand | SendOffer | SendResult:
    match message:
        case Demand():
            return SendDemand.of(message)
        case Offer():
            return SendOffer.of(message)
    return SendResult.of(message)


@given(orders(addresses))
def test_a_signed_order_survives_a_request(order: Order) -> None:
    request = request_of(order)
    assert type(request).decode(request.encode()).message() == order


@given(results(addresses))
def test_a_signed_result_survives_a_request(result: Result) -> None:
    assert SendResult.decode(SendResult.of(result).encode()).message() == result


def test_the_fields_are_those_of_the_wire_with_amounts_in_strings() -> None:
    held = json.loads(SendDemand.of(DEMAND_5).encode())
    assert (held["cost"], held["validatorFee"]) == (str(DEMAND_5.cost), str(DEMAND_5.validator_fee))
    assert (held["nonce"], held["sender"]) == (str(DEMAND_5.nonce), DEMAND_5.sender)
    assert "sender" not in json.loads(SendDemand.of(DEMAND).encode())


def sign_request(order: Order) -> dict[str, Any]:
    return {name: value for name, value in asdict(order).items() if name not in ("nonce", "sender", "signature")}


def test_a_request_to_sign_becomes_the_unsigned_message() -> None:
    demand = SignDemand(**sign_request(DEMAND)).unsigned(nonce=DEMAND.nonce, sender=None)
    assert demand == replace(DEMAND, signature="")
    offer = SignOffer(**sign_request(OFFER)).unsigned(nonce=OFFER.nonce, sender=None)
    assert offer == replace(OFFER, signature="")
    fifth = SignDemand(**sign_request(DEMAND_5)).unsigned(nonce=DEMAND_5.nonce, sender=DEMAND_5.sender)
    assert fifth == replace(DEMAND_5, signature="")
    result = SignResult(liability=RESULT.liability, result=RESULT.result, success=RESULT.success)
    assert result.unsigned() == replace(RESULT, signature="")


@pytest.mark.parametrize("nonce", ["", "0x12", "1 2", "-1", "1.0", "٣", "9" * 79])
def test_a_counted_nonce_is_decimal_digits(nonce: str) -> None:
    with pytest.raises(InvalidMessage) as caught:
        replace(SendDemand.of(DEMAND_5), nonce=nonce).message()
    assert caught.value.reason == "nonce"


def test_a_request_with_missing_or_unknown_fields_is_refused() -> None:
    held = json.loads(SendDemand.of(DEMAND).encode())
    for wrong in (held | {"extra": 1}, {name: held[name] for name in held if name != "nonce"}, held | {"cost": 1}):
        with pytest.raises(InvalidRecord):
            SendDemand.decode(json.dumps(wrong).encode())


def test_an_invalid_message_is_refused_when_it_is_built() -> None:
    with pytest.raises(InvalidMessage) as caught:
        replace(SendDemand.of(DEMAND), objective="the kitchen").message()
    assert "objective" in caught.value.detail


@pytest.mark.parametrize(
    "wrong", [{"maker": "0x12"}, {"token": DEMAND.token.lower()}, {"generation": 4}, {"cost": -1}, {"cost": 2**256}]
)
def test_a_question_for_the_fee_of_a_permit_names_an_order_that_can_be(wrong: dict[str, Any]) -> None:
    asked: dict[str, Any] = {"maker": DEMAND.token, "generation": 3, "token": DEMAND.token, "cost": 5}
    assert PermitFeeRequest.decode(PermitFeeRequest(**asked).encode()) == PermitFeeRequest(**asked)
    with pytest.raises(InvalidRecord):
        PermitFeeRequest(**asked | wrong)


def test_guarded_services_exist() -> None:
    assert SPENDING < GUARDED < SERVICES.keys()
    named = {service for service in SERVICES if service.startswith(("sign/", "send/"))}
    assert named | {"control"} == GUARDED - SPENDING

"""Records: the liability, and the requests and replies of an agent's services."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import MAX_UINT256, ZERO_ADDRESS, InvalidRecord, Liability, PlaybackPosition, Record
from schemas.rpc import (
    SERVICES,
    Accounts,
    AccountToAddressAllowance,
    ApprovalEvent,
    Balance,
    BlockNumber,
    Done,
    FinishLiability,
    LiabilityRead,
    LiabilityRequest,
    Nothing,
    SignDemand,
    TransferEvent,
    TransferFromRequest,
)
from tests.support.schemas.samples import LIGHTHOUSE, MODEL, OBJECTIVE, SENDER, TOKEN
from tests.support.schemas.strategies import amounts

LIABILITY = Liability(
    address=LIGHTHOUSE,
    model=MODEL,
    objective=OBJECTIVE,
    result="",
    promisee=SENDER,
    promisor=TOKEN,
    lighthouse=LIGHTHOUSE,
    lighthouse_fee=MAX_UINT256,
    token=TOKEN,
    cost=2**53 + 1,
    validator=ZERO_ADDRESS,
    validator_fee=0,
    is_success=False,
    is_finalized=True,
)

LIABILITY_JSON = {
    "address": LIGHTHOUSE,
    "model": MODEL,
    "objective": OBJECTIVE,
    "result": "",
    "promisee": SENDER,
    "promisor": TOKEN,
    "lighthouse": LIGHTHOUSE,
    "lighthouseFee": str(MAX_UINT256),
    "token": TOKEN,
    "cost": "9007199254740993",
    "validator": ZERO_ADDRESS,
    "validatorFee": "0",
    "isSuccess": False,
    "isFinalized": True,
}


def test_liability_has_the_legacy_names_and_amounts_in_strings() -> None:
    assert json.loads(LIABILITY.encode()) == LIABILITY_JSON
    assert Liability.decode(json.dumps(LIABILITY_JSON).encode()) == LIABILITY


def test_amounts_are_integers_in_python() -> None:
    assert LIABILITY.cost + 1 == 2**53 + 2
    assert Liability.decode(LIABILITY.encode()).lighthouse_fee == MAX_UINT256
    assert "cost=9007199254740993" in repr(LIABILITY)


@given(amounts)
def test_every_amount_survives(amount: int) -> None:
    assert Balance.decode(Balance(amount).encode()) == Balance(amount)


@pytest.mark.parametrize("value", [-1, MAX_UINT256 + 1, True, 1.0, "1", None])
def test_amounts_are_checked(value: Any) -> None:
    with pytest.raises(InvalidRecord) as caught:
        Balance(value)
    assert "balance" in caught.value.why
    assert caught.value.kind == "Balance"


@pytest.mark.parametrize(
    "text",
    [
        "1",
        "-1",
        '""',
        '"-1"',
        '"+1"',
        '"0x1"',
        '"1.0"',
        '" 1"',
        '"1_0"',
        '"\u0661"',
        "null",
        "true",
        '"' + "9" * 79 + '"',
    ],
)
def test_amounts_are_decimal_strings_on_the_wire(text: str) -> None:
    with pytest.raises(InvalidRecord):
        Balance.decode(f'{{"balance":{text}}}'.encode())


def test_amount_beyond_256_bits_is_refused_on_the_wire() -> None:
    with pytest.raises(InvalidRecord) as caught:
        Balance.decode(f'{{"balance":"{MAX_UINT256 + 1}"}}'.encode())
    assert "balance" in caught.value.why
    assert caught.value.kind == "Balance"


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        (LiabilityRequest(LIGHTHOUSE), {"address": LIGHTHOUSE}),
        (FinishLiability(LIGHTHOUSE, success=True), {"address": LIGHTHOUSE, "success": True}),
        (Done(success=False, msg="no such liability"), {"success": False, "msg": "no such liability"}),
        (Nothing(), {}),
        (LiabilityRead(read=True, liability=LIABILITY), {"read": True, "liability": LIABILITY_JSON}),
        (LiabilityRead(read=False), {"read": False, "liability": None}),
        (Accounts((SENDER,)), {"accounts": [SENDER]}),
        (BlockNumber(7), {"number": 7}),
        (AccountToAddressAllowance(SENDER, TOKEN), {"account": SENDER, "to": TOKEN}),
        (TransferFromRequest(SENDER, TOKEN, 5), {"owner": SENDER, "to": TOKEN, "value": "5"}),
        (TransferEvent(SENDER, TOKEN, 5), {"args_from": SENDER, "args_to": TOKEN, "args_value": "5"}),
        (ApprovalEvent(SENDER, TOKEN, 5), {"args_owner": SENDER, "args_spender": TOKEN, "args_value": "5"}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_records_travel_with_the_legacy_names(record: Record, expected: dict[str, Any]) -> None:
    assert json.loads(record.encode()) == expected
    assert type(record).decode(record.encode()) == record


def test_demand_to_sign_has_the_names_of_the_message() -> None:
    request = SignDemand(
        model=MODEL,
        objective=OBJECTIVE,
        token=TOKEN,
        cost=1,
        lighthouse=LIGHTHOUSE,
        validator=ZERO_ADDRESS,
        validator_fee=2,
        deadline=3,
    )
    assert json.loads(request.encode())["validatorFee"] == "2"
    assert SignDemand.decode(request.encode()) == request


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{}",
        b'{"address":1}',
        b'{"address":"a","more":1}',
        b'{"address":"\xff"}',
        b'{"address":' + b"[" * 60_000,
        b" " * 65_537,
        b'{"a\nb":1}',
    ],
    ids=lambda data: repr(data[:20]),
)
def test_invalid_records_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidRecord) as caught:
        LiabilityRequest.decode(data)
    assert caught.value.kind == "LiabilityRequest"
    assert "\n" not in str(caught.value)


@given(
    st.sampled_from(sorted({kind for service in SERVICES.values() for kind in service}, key=repr)),
    st.binary(max_size=100),
)
def test_any_bytes_decode_or_raise_invalid_record(kind: type[Record], data: bytes) -> None:
    with suppress(InvalidRecord):
        kind.decode(data)


def test_every_legacy_service_exists() -> None:
    assert {
        "start",
        "finish",
        "restart",
        "resume",
        "read",
        "sign/demand",
        "sign/offer",
        "sign/result",
    } <= SERVICES.keys()
    assert {name.removeprefix("eth/") for name in SERVICES if name.startswith("eth/")} == {
        "accounts",
        "account_eth_balance",
        "eth_balance",
        "current_block",
        "transfer",
        "transfer_from",
        "approve",
        "account_xrt_balance",
        "xrt_balance",
        "account_xrt_allowance",
        "xrt_allowance",
    }


def test_services_can_not_be_changed() -> None:
    with pytest.raises(TypeError):
        SERVICES["start"] = SERVICES["read"]  # type: ignore[index]


def test_records_are_frozen() -> None:
    with pytest.raises(AttributeError):
        LIABILITY.cost = 1  # type: ignore[misc]
    assert msgspec.structs.replace(LIABILITY, cost=1).cost == 1


@pytest.mark.parametrize(("position", "total"), [(0, 0), (0, 3), (3, 3)])
def test_a_position_is_read_as_written(position: int, total: int) -> None:
    playback = PlaybackPosition(position=position, total=total)
    assert PlaybackPosition.decode(playback.encode()) == playback


@pytest.mark.parametrize(("position", "total"), [(-1, 3), (4, 3), (0, 2**53), (0, -1)])
def test_a_position_lies_within_its_total(position: int, total: int) -> None:
    with pytest.raises(InvalidRecord):
        PlaybackPosition.decode(json.dumps({"position": position, "total": total}).encode())

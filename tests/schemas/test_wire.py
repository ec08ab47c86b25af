"""The JSON of messages: decoding, reasons of rejection, encoding."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

import schemas
from schemas import (
    MAX_MESSAGE_SIZE,
    MAX_UINT256,
    Demand,
    InvalidMessage,
    Message,
    Offer,
    OrderFeedback,
    Result,
    TransactionFeedback,
    cid,
    cid_of_digest,
    encode,
    verify,
)
from schemas.messages import MESSAGE_TYPES, parse_cids_ahead
from tests.support.schemas.samples import (
    DEMAND,
    DEMAND_5,
    DEMAND_5_JSON,
    DEMAND_JSON,
    FEEDBACK_JSON,
    LIGHTHOUSE,
    MODEL,
    NONCE,
    OFFER,
    OFFER_JSON,
    RESULT,
    RESULT_JSON,
    SIGNATURE,
    TERMS,
    TRANSACTION_JSON,
    WITHDRAWAL,
    WITHDRAWAL_JSON,
    payload,
)
from tests.support.schemas.strategies import messages

EVERY_KIND = (DEMAND_JSON, DEMAND_5_JSON, OFFER_JSON, RESULT_JSON, FEEDBACK_JSON, TRANSACTION_JSON)


def outcome(data: bytes, likely: type[Message] | None) -> Message | tuple[str, str]:
    try:
        return schemas.decode(data, likely)
    except InvalidMessage as error:
        return error.reason, error.detail


def decode(data: bytes) -> Message:
    """The message, or the error, which are the same whatever kind is likely."""
    for kind in MESSAGE_TYPES:
        assert outcome(data, kind) == outcome(data, None)
    return schemas.decode(data)


def reason(data: bytes) -> str:
    with pytest.raises(InvalidMessage) as caught:
        decode(data)
    assert "\n" not in str(caught.value)
    return caught.value.reason


@given(messages())
def test_a_message_round_trips(message: Message) -> None:
    assert decode(encode(message)) == message


@given(messages(), st.randoms(use_true_random=False))
def test_order_of_fields_and_blanks_do_not_matter(message: Message, random: Any) -> None:
    fields = list(json.loads(encode(message)).items())
    random.shuffle(fields)
    assert decode(json.dumps(dict(fields), indent=2).encode()) == message


def test_the_fields_determine_the_kind() -> None:
    assert decode(payload(DEMAND_JSON)) == DEMAND
    assert decode(payload(DEMAND_5_JSON)) == DEMAND_5
    assert decode(payload(OFFER_JSON)) == OFFER
    assert decode(payload(WITHDRAWAL_JSON)) == WITHDRAWAL
    assert decode(payload(RESULT_JSON)) == RESULT
    assert decode(payload(FEEDBACK_JSON)) == OrderFeedback(order=NONCE, accepted=1, signature=SIGNATURE)
    assert decode(payload(TRANSACTION_JSON)) == TransactionFeedback(tx=NONCE)


def test_a_text_like_a_field_of_another_kind_determines_nothing() -> None:
    assert reason(b'{"tx":"accepted"}') == "hash"


def test_keys_may_be_spelled_with_escapes() -> None:
    escaped = payload(DEMAND_JSON).replace(b"validatorFee", b"validator\\u0046ee").replace(b"model", b"\\u006dodel")
    assert decode(escaped) == DEMAND
    assert decode(payload(TRANSACTION_JSON).replace(b"tx", b"\\u0074x")) == TransactionFeedback(tx=NONCE)


def test_generation_3_is_written_without_sender() -> None:
    assert "sender" not in json.loads(encode(DEMAND))
    assert json.loads(encode(DEMAND)) == DEMAND_JSON
    assert json.loads(encode(DEMAND_5)) == DEMAND_5_JSON


def test_json_is_compact() -> None:
    assert b" " not in encode(DEMAND)


def test_integers_beyond_64_bits_survive() -> None:
    for value in (2**53 + 1, 2**63, 2**64, MAX_UINT256):
        read = decode(payload(DEMAND_5_JSON, cost=value, validatorFee=value, deadline=value, nonce=value))
        assert isinstance(read, Demand)
        assert (read.cost, read.validator_fee, read.deadline, read.nonce) == (value,) * 4
        assert json.loads(encode(read))["cost"] == value


def test_an_unsigned_message_is_not_encoded() -> None:
    unsigned = Offer(**{**TERMS, "signature": ""}, lighthouse_fee=0)
    with pytest.raises(InvalidMessage) as caught:
        encode(unsigned)
    assert caught.value.reason == "signature"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00",
        b"{",
        b"nul",
        b"NaN",
        b"{'tx':1}",
        b'{"tx":}',
        f'{{"tx":"{NONCE}"}} {{}}'.encode(),
        b'{"liability":01}',
        b'{"validatorFee":NaN}',
        b'\xef\xbb\xbf{"tx":"a"}',
        '{"tx":"a"}'.encode("utf-16"),
        b'{"tx":"\xff"}',
        b'{"tx":"\xed\xa0\x80"}',
        b'{"tx":"\\ud800"}',
        b'{"tx":"\\ud800\\u0041"}',
        b'{"tx":"\\udc00aaaaaaaaaaaaaa"}',
        b'{"\xff":1}',
        b'{"a":' * 3_000,
    ],
    ids=lambda data: repr(data[:20]),
)
def test_invalid_json_is_refused(data: bytes) -> None:
    assert reason(data) == "not-json"


def test_deep_json_is_refused() -> None:
    assert reason(b'{"a":' + b"[" * 8_000 + b"]" * 8_000 + b"}") == "not-json"


@pytest.mark.parametrize("data", [b"[" * 16_000, b"[]", b"5", b"null", b'"tx"', b"{}", b'{"model":1}', b'[{"tx":"a"}]'])
def test_json_that_is_not_a_message_is_refused(data: bytes) -> None:
    assert reason(data) in {"unknown-kind", "field"}


def test_both_fees_at_once_are_refused() -> None:
    both = payload(DEMAND_JSON, lighthouseFee=7)
    assert reason(both) == "unknown-kind"
    assert reason(both.replace(b"lighthouseFee", b"lighthouse\\u0046ee")) == "unknown-kind"
    assert reason(both.replace(b"validatorFee", b"validator\\u0046ee")) == "unknown-kind"


@pytest.mark.parametrize("fields", EVERY_KIND, ids=lambda fields: ",".join(list(fields)[-2:]))
def test_missing_fields_are_refused(fields: dict[str, Any]) -> None:
    for field in fields.keys() - {"sender", "tx"}:
        assert reason(payload(fields, **{field: ...})) in {"field", "unknown-kind", "unknown-field"}


def test_missing_sender_makes_the_nonce_wrong() -> None:
    assert reason(payload(DEMAND_5_JSON, sender=...)) == "nonce"
    assert reason(payload(DEMAND_JSON, sender=LIGHTHOUSE)) == "nonce"


def test_missing_field_is_named() -> None:
    with pytest.raises(InvalidMessage) as caught:
        decode(payload(DEMAND_JSON, deadline=...))
    assert "deadline" in caught.value.detail
    assert caught.value.reason == "field"
    with pytest.raises(InvalidMessage) as caught:
        decode(payload(RESULT_JSON, signature=...))
    assert "signature" in caught.value.detail
    assert caught.value.reason == "field"


@pytest.mark.parametrize("fields", EVERY_KIND, ids=lambda fields: ",".join(list(fields)[-2:]))
@pytest.mark.parametrize("name", ["extra", "__class__", "validator_fee", "é", "a\nb", "", "Cost"])
def test_unknown_fields_are_refused(fields: dict[str, Any], name: str) -> None:
    assert reason(payload(fields, **{name: 1})) == "unknown-field"


def test_fields_of_another_kind_are_unknown() -> None:
    assert reason(payload(DEMAND_JSON, accepted=1)) == "unknown-field"
    assert reason(payload(RESULT_JSON, tx=NONCE)) == "unknown-field"
    assert reason(payload(FEEDBACK_JSON, sender=LIGHTHOUSE)) == "unknown-field"


@pytest.mark.parametrize("fields", EVERY_KIND, ids=lambda fields: ",".join(list(fields)[-2:]))
def test_repeated_fields_are_refused(fields: dict[str, Any]) -> None:
    text = payload(fields).decode()
    for name, value in fields.items():
        for repeated in (json.dumps(name), f'"\\u{ord(name[0]):04x}{name[1:]}"'):
            again = f"{{{repeated}:{json.dumps(value)},{text[1:]}"
            assert reason(again.encode()) == "duplicate-field"


def test_repeated_field_with_anything_in_it_is_refused() -> None:
    for value in (b'"::::"', b'"\\u003a"', b"null", b"{}", b"[1,2]"):
        data = payload(RESULT_JSON).replace(b"{", b'{"result":' + value + b",", 1)
        assert reason(data) in {"duplicate-field", "field", "cid"}


@pytest.mark.parametrize("value", [1.0, 1e3, "1", True, False, None, [1], {"a": 1}])
@pytest.mark.parametrize("field", ["cost", "deadline", "validatorFee"])
def test_amounts_are_integers(field: str, value: object) -> None:
    assert reason(payload(DEMAND_JSON, **{field: value})) == "field"


def test_nonce_of_generation_5_is_an_integer() -> None:
    values: tuple[object, ...] = (1.5, None, [], True)
    for value in values:
        assert reason(payload(DEMAND_5_JSON, nonce=value)) in {"field", "nonce"}
    assert reason(payload(DEMAND_5_JSON, nonce="3")) == "nonce"


@pytest.mark.parametrize("value", [-1, MAX_UINT256 + 1, -(2**300)])
def test_amounts_are_in_range(value: int) -> None:
    for field in ("cost", "deadline", "validatorFee"):
        assert reason(payload(DEMAND_JSON, **{field: value})) == "range"
    assert reason(payload(DEMAND_5_JSON, nonce=value)) == "range"
    assert reason(payload(FEEDBACK_JSON, accepted=value)) == "range"


def test_endless_integers_are_refused() -> None:
    for digits in (5_000, 15_000):
        data = payload(DEMAND_JSON).replace(b'"cost": 42', b'"cost": ' + b"9" * digits)
        assert reason(data) in {"field", "range"}


@pytest.mark.parametrize("value", [1, 0, "true", None, [], 1.0])
def test_success_is_a_boolean(value: object) -> None:
    assert reason(payload(RESULT_JSON, success=value)) == "field"


@pytest.mark.parametrize("value", [None, 1, True, ["a"], {"a": "b"}])
@pytest.mark.parametrize("field", ["model", "token", "lighthouse", "signature"])
def test_texts_are_texts(field: str, value: object) -> None:
    assert reason(payload(DEMAND_JSON, **{field: value})) == "field"


def test_sender_is_not_null() -> None:
    assert reason(payload(DEMAND_JSON, sender=None)) == "field"
    assert reason(payload(DEMAND_5_JSON, sender=None)) == "nonce"


def test_texts_are_checked() -> None:
    for field, value, expected in (
        ("model", MODEL.replace("Q", "0"), "cid"),
        ("objective", MODEL + "a", "cid"),
        ("token", LIGHTHOUSE.swapcase().replace("0X", "0x"), "address"),
        ("lighthouse", "light house.eth", "address"),
        ("nonce", "0" * 63, "nonce"),
        ("signature", "", "signature"),
        ("signature", "00", "signature"),
    ):
        assert reason(payload(DEMAND_JSON, **{field: value})) == expected
    assert reason(payload(TRANSACTION_JSON, tx="00")) == "hash"


def test_size_is_bounded() -> None:
    padded = payload(DEMAND_JSON)
    padded += b" " * (MAX_MESSAGE_SIZE - len(padded))
    assert decode(padded) == DEMAND
    assert reason(padded + b" ") == "too-large"


@given(st.binary(max_size=300) | st.text(max_size=300).map(lambda text: text.encode("utf-8", "surrogatepass")))
def test_any_bytes_decode_or_raise_invalid_message(data: bytes) -> None:
    for read in (decode, verify):
        with pytest.raises(InvalidMessage):
            read(data)


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from((MODEL, LIGHTHOUSE, NONCE)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(EVERY_KIND), st.data())
def test_any_changed_field_decodes_or_raises_invalid_message(fields: dict[str, Any], data: st.DataObject) -> None:
    field = data.draw(st.sampled_from(sorted(fields)))
    with suppress(InvalidMessage):
        verify(payload(fields, **{field: data.draw(ANY_JSON)}))


@given(st.sampled_from(EVERY_KIND), st.integers(0, 2000), st.binary(max_size=6))
@example(TRANSACTION_JSON, 3, b"\\ud800")
def test_damaged_messages_decode_or_raise_invalid_message(fields: dict[str, Any], position: int, damage: bytes) -> None:
    whole = payload(fields)
    position %= len(whole)
    for damaged in (whole[:position] + damage + whole[position + len(damage) :], whole[:position] + damage):
        with suppress(InvalidMessage):
            assert decode(encode(decode(damaged))) == decode(damaged)


@pytest.mark.parametrize("message", [DEMAND, DEMAND_5, OFFER, RESULT])
def test_new_cids_of_many_messages_are_parsed_together(
    message: Demand | Offer | Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = "result" if isinstance(message, Result) else "objective"
    cids = [cid_of_digest(bytes([number] * 32)) for number in range(20)]
    payloads = [encode(replace(message, **{field: cid})) for cid in cids]
    parse_cids_ahead([*payloads, b"", b'"objective":"', b'"result":"\xff'], type(message))
    monkeypatch.setattr(cid, "_blocks", None)
    assert [getattr(schemas.decode(payload), field) for payload in payloads] == cids

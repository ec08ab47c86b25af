"""ENS names in messages."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given

from schemas import (
    InvalidAddress,
    InvalidMessage,
    Message,
    OrderFeedback,
    TransactionFeedback,
    checksum_address,
    decode,
    keccak256,
    message_hash,
    names_in,
    resolve_names,
)
from tests.schemas.samples import (
    DEMAND,
    DEMAND_5,
    DEMAND_JSON,
    LIGHTHOUSE,
    LIGHTHOUSE_NAME,
    NONCE,
    RESULT,
    SENDER,
    SIGNATURE,
    TOKEN,
    payload,
)
from tests.schemas.strategies import messages


def test_message_with_addresses_only_has_no_names() -> None:
    feedback = (OrderFeedback(order=NONCE, accepted=1, signature=SIGNATURE), TransactionFeedback(tx=NONCE))
    for message in (DEMAND, DEMAND_5, RESULT, *feedback):
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
    with pytest.raises(InvalidMessage, match=r"nobody\.eth") as caught:
        resolve_names(named, {})
    assert caught.value.reason == "unresolved-name"


def test_name_that_maps_to_no_address_is_refused() -> None:
    named = msgspec.structs.replace(RESULT, liability="nobody.eth")
    with pytest.raises(InvalidAddress):
        resolve_names(named, {"nobody.eth": "somewhere"})


@given(messages())
def test_names_are_gone_after_resolving(message: Message) -> None:
    addresses = {name: checksum_address(keccak256(name.encode())[:20]) for name in names_in(message)}
    assert names_in(resolve_names(message, addresses)) == frozenset()

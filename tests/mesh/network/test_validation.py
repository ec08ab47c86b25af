"""The door: who may pass, and under which reason the others are counted."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from mesh.network import MessageValidator, message_key, verification
from mesh.network.validation import Unresolved
from schemas import Demand, Offer, Result, SignedMessage, Verified, encode, message_hash
from tests.support.orders import (
    LIGHTHOUSE,
    MARKET,
    OTHER_MODEL,
    PERSON,
    ROBOT,
    STRANGER,
    demand,
    offer,
    result,
    terms,
)

HEAD = 100
NAME = "xrt.3.robonomics.eth"


def door(kind: type[Any] = Demand, **options: Any) -> MessageValidator[Any]:
    given: dict[str, Any] = {"lighthouse": MARKET, "address": LIGHTHOUSE, "head": lambda: HEAD} | options
    return MessageValidator(kind, **given)


def counted(checked: MessageValidator[Any]) -> dict[str, int]:
    return dict(checked.statistics(received=0, dropped=0).invalid)


def pass_through(
    checked: MessageValidator[Any], message: SignedMessage, key: str | None = None
) -> Verified[Any] | None:
    passed = checked.check(key or message_key(MARKET, message), encode(message))
    assert not isinstance(passed, Unresolved)
    return passed


@pytest.mark.parametrize(("kind", "make"), [(Demand, demand), (Offer, offer), (Result, result)])
def test_a_signed_message_on_its_key_passes_with_hash_and_signer(kind: type[Any], make: Any) -> None:
    message = make(signer=STRANGER)

    assert pass_through(door(kind), message) == Verified(message, message_hash(message), STRANGER.address)


def test_a_generation_5_order_passes_too() -> None:
    message = demand(signer=PERSON, sender=PERSON.address, nonce=7)

    assert pass_through(door(), message) is not None


WRONG_ORDERS: dict[str, Demand | Offer] = {
    "nonce": demand(nonce="00" * 12 + "ff" * 20),
    "deadline": demand(deadline=HEAD),
    "lighthouse": demand(lighthouse=STRANGER.address),
    "kind": offer(),
    "signature": Demand(**terms(), validator_fee=0, signature="ff" * 65),
    "sender": Demand(
        **terms(sender=PERSON.address, nonce=1),
        validator_fee=0,
        signature=demand().signature,
    ),
}


@pytest.mark.parametrize("reason", WRONG_ORDERS)
def test_an_order_that_is_wrong_is_counted_under_its_reason(reason: str) -> None:
    checked = door()

    assert pass_through(checked, WRONG_ORDERS[reason]) is None
    assert counted(checked) == {reason: 1}


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not-json"),
        (b"{", "not-json"),
        (b"\xff\xfe", "not-json"),
        (b'"text"', "unknown-kind"),
        (b"{}", "unknown-kind"),
        (b"[" * 100_000, "too-large"),
        (b'{"validatorFee": 1}', "field"),
        (b'{"tx": "' + b"00" * 32 + b'"}', "kind"),
    ],
)
def test_what_is_no_message_is_counted_as_such(payload: bytes, reason: str) -> None:
    checked = door()

    assert checked.check(message_key(MARKET, demand()), payload) is None
    assert counted(checked) == {reason: 1}


MESSAGE = demand()
DIGEST = message_hash(MESSAGE).hex()
RIGHT_KEY = message_key(MARKET, MESSAGE)


@pytest.mark.parametrize(
    "key",
    [
        RIGHT_KEY.replace(MESSAGE.model, OTHER_MODEL),
        RIGHT_KEY.replace(DIGEST, message_hash(demand()).hex()),
        RIGHT_KEY.replace(DIGEST, DIGEST.upper()),
        RIGHT_KEY.replace("demand", "offer"),
        RIGHT_KEY.replace(MARKET, "other.lighthouse.3.robonomics.eth"),
        RIGHT_KEY + "/more",
        f"aira/{MARKET}/demand/*/{DIGEST}",
        f"aira/{MARKET}/demand/{MESSAGE.model}/*",
        f"aira/{MARKET}/demand/**",
        "**",
    ],
)
def test_a_message_on_another_key_than_its_own_is_counted(key: str) -> None:
    checked = door()

    assert pass_through(checked, MESSAGE, key) is None
    assert counted(checked) == {"key": 1}


def test_a_changed_message_does_not_belong_on_the_key_of_the_original() -> None:
    checked, message = door(), demand(cost=1)
    altered = json.loads(encode(message)) | {"cost": 2}

    assert checked.check(message_key(MARKET, message), json.dumps(altered).encode()) is None
    assert counted(checked) == {"key": 1}


def test_a_result_belongs_on_the_key_of_its_liability() -> None:
    checked, message = door(Result), result(liability=ROBOT.address)
    other = message_key(MARKET, message).replace(ROBOT.address.lower(), STRANGER.address.lower())

    assert pass_through(checked, message, other) is None
    assert counted(checked) == {"key": 1}


def test_eleven_zero_bytes_of_a_nonce_are_none_too_many() -> None:
    assert pass_through(door(), demand(nonce="00" * 11 + "ff" * 21)) is not None


def test_an_order_is_valid_until_the_block_before_its_deadline() -> None:
    assert pass_through(door(), demand(deadline=HEAD + 1)) is not None
    assert pass_through(door(), demand(deadline=HEAD)) is None


def test_without_the_head_and_the_address_neither_is_checked() -> None:
    checked = door(address=None, head=lambda: 0)

    assert pass_through(checked, demand(deadline=1, lighthouse=STRANGER.address)) is not None


def test_the_same_message_passes_once() -> None:
    checked, message = door(), demand()

    assert [pass_through(checked, message) is not None for _ in range(3)] == [True, False, False]
    assert checked.statistics(received=3, dropped=0) == verification.Statistics(
        received=3, accepted=1, invalid={}, duplicate=2, dropped=0
    )


def test_equal_terms_of_generation_3_signed_by_two_people_are_two_messages() -> None:
    checked, same = door(), terms()
    first, second = (signer.sign(Demand(**same, validator_fee=0)) for signer in (PERSON, STRANGER))

    assert message_key(MARKET, first) == message_key(MARKET, second)
    passed = [pass_through(checked, message) for message in (first, second)]
    assert [one.signer for one in passed if one is not None] == [PERSON.address, STRANGER.address]


def test_a_message_that_did_not_pass_may_pass_later() -> None:
    head = HEAD
    checked, message = door(head=lambda: head), demand(deadline=HEAD)
    assert pass_through(checked, message) is None

    head = HEAD - 1

    assert pass_through(checked, message) is not None


def test_a_forgotten_message_passes_once_more() -> None:
    checked, message = door(), demand()
    passed = pass_through(checked, message)
    assert passed is not None

    checked.forget(passed)
    checked.forget(passed)

    assert pass_through(checked, message) == passed
    assert pass_through(checked, message) is None


def test_the_memory_of_what_passed_is_limited_and_the_oldest_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "REMEMBERED", 2)
    checked, messages = door(), [demand() for _ in range(3)]
    for message in messages:
        assert pass_through(checked, message) is not None

    assert pass_through(checked, messages[2]) is None
    assert pass_through(checked, messages[0]) is not None


def test_a_message_with_a_name_waits_until_it_is_looked_up_and_passes_then() -> None:
    checked, message = door(), demand(token=STRANGER.address)
    named = json.loads(encode(message)) | {"token": NAME.upper()}
    key = message_key(MARKET, message)

    waiting = checked.check(key, json.dumps(named).encode())

    assert isinstance(waiting, Unresolved)
    assert waiting.message.token == NAME
    assert checked.resolved(waiting, {NAME: STRANGER.address}) == Verified(
        message, message_hash(message), PERSON.address
    )
    assert checked.check(key, json.dumps(named).encode()) is None, "a duplicate is not looked up again"
    assert checked.resolved(waiting, {NAME: STRANGER.address}) is None, "what passed meanwhile does not pass twice"
    assert checked.statistics(received=0, dropped=0).duplicate == 2


@pytest.mark.parametrize(
    ("address", "reason"), [({NAME: ROBOT.address}, "key"), ({}, "unresolved-name")], ids=["wrong", "missing"]
)
def test_a_name_that_means_something_else_than_what_was_signed_is_counted(address: dict[str, str], reason: str) -> None:
    checked, message = door(), demand(token=STRANGER.address)
    named = json.loads(encode(message)) | {"token": NAME}
    waiting = checked.check(message_key(MARKET, message), json.dumps(named).encode())
    assert isinstance(waiting, Unresolved)

    assert checked.resolved(waiting, address) is None
    assert counted(checked) == {reason: 1}


def test_many_threads_let_each_message_pass_once_and_count_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "REMEMBERED", 300)
    checked = door()
    messages = [demand() for _ in range(200)]
    refused = offer()

    def check_all() -> list[bytes]:
        passed = [pass_through(checked, message) for message in messages]
        for _ in range(200):
            pass_through(checked, refused)
        return [one.hash for one in passed if one is not None]

    with ThreadPoolExecutor(8) as threads:
        jobs = [threads.submit(check_all) for _ in range(8)]
        passed = Counter(digest for job in jobs for digest in job.result())

    assert passed == Counter(message_hash(message) for message in messages)
    statistics = checked.statistics(received=0, dropped=0)
    assert statistics.duplicate == 7 * 200
    assert statistics.invalid == {"kind": 8 * 200}


def test_an_altered_result_does_not_belong_on_the_key_of_the_original() -> None:
    checked, message = door(Result), result(success=True)
    altered = json.loads(encode(message)) | {"success": False}

    assert checked.check(message_key(MARKET, message), json.dumps(altered).encode()) is None
    assert counted(checked) == {"key": 1}

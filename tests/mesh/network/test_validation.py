"""The message validator: which messages it accepts, and under which reason it counts the others."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from mesh.network import ValidationStatistics, _validation, message_key
from schemas import Demand, Offer, Result, Verified, encode, message_hash
from schemas.signing import SignedDigest, recover_keys
from tests.support.clocks import SECOND, SetClock
from tests.support.network.validating import HEAD, check, check_payload, counted, validator
from tests.support.orders import (
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

if TYPE_CHECKING:
    from collections.abc import Iterable


@pytest.mark.parametrize(("kind", "make"), [(Demand, demand), (Offer, offer), (Result, result)])
def test_a_signed_message_on_its_key_is_accepted_with_hash_and_signer(kind: type[Any], make: Any) -> None:
    message = make(signer=STRANGER)

    assert check(validator(kind), message) == Verified(message, message_hash(message), STRANGER.address)


def test_a_generation_5_order_is_accepted() -> None:
    message = demand(signer=PERSON, sender=PERSON.address, nonce=7)

    assert check(validator(), message) is not None


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
def test_an_invalid_order_is_counted_under_its_reason(reason: str) -> None:
    checked = validator()

    assert check(checked, WRONG_ORDERS[reason]) is None
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
def test_invalid_input_is_counted_under_its_reason(payload: bytes, reason: str) -> None:
    checked = validator()

    assert check_payload(checked, message_key(MARKET, demand()), payload) is None
    assert counted(checked) == {reason: 1}


MESSAGE = demand()
RIGHT_KEY = message_key(MARKET, MESSAGE)


@pytest.mark.parametrize(
    "key",
    [
        RIGHT_KEY.replace(MESSAGE.model, OTHER_MODEL),
        RIGHT_KEY.replace(MESSAGE.model, MESSAGE.model.upper()),
        RIGHT_KEY.replace("demand", "offer"),
        RIGHT_KEY.replace(MARKET, "other.lighthouse.3.robonomics.eth"),
        RIGHT_KEY + "/more",
        f"aira/{MARKET}/demand/*",
        f"aira/{MARKET}/demand/{MESSAGE.model}/*",
        f"aira/{MARKET}/demand/**",
        "**",
    ],
)
def test_a_message_on_the_wrong_key_is_counted(key: str) -> None:
    checked = validator()

    assert check(checked, MESSAGE, key) is None
    assert counted(checked) == {"key": 1}


@pytest.mark.parametrize("make", [demand, result])
def test_a_changed_message_is_not_its_signers_and_does_not_keep_the_original_out(make: Any) -> None:
    """Some other key made the same signature of the changed message, or none did."""
    message = make()
    checked = validator(type(message))
    changes = {"cost": 2} if isinstance(message, Demand) else {"success": not message.success}
    altered = json.dumps(json.loads(encode(message)) | changes).encode()

    verified = check_payload(checked, message_key(MARKET, message), altered)

    signer = PERSON if isinstance(message, Demand) else ROBOT
    assert not isinstance(verified, Verified) or verified.signer != signer.address
    original = check(checked, message)
    assert original is not None
    assert original.signer == signer.address


def test_a_nonce_may_start_with_eleven_zero_bytes() -> None:
    assert check(validator(), demand(nonce="00" * 11 + "ff" * 21)) is not None


def test_an_order_is_valid_until_the_block_before_its_deadline() -> None:
    assert check(validator(), demand(deadline=HEAD + 1)) is not None
    assert check(validator(), demand(deadline=HEAD)) is None


def test_without_the_head_and_the_address_neither_is_checked() -> None:
    checked = validator(address=None, head=lambda: 0)

    for deadline in (0, 1):
        assert check(checked, demand(deadline=deadline, lighthouse=STRANGER.address)) is not None


def test_the_same_message_is_accepted_once() -> None:
    checked, message = validator(), demand()

    assert [check(checked, message) is not None for _ in range(3)] == [True, False, False]
    assert checked.statistics(received=3, dropped=0) == ValidationStatistics(
        received=3, accepted=1, invalid={}, duplicate=2, dropped=0
    )


def test_a_rejected_message_may_be_accepted_later() -> None:
    head = HEAD
    checked, message = validator(head=lambda: head), demand(deadline=HEAD)
    assert check(checked, message) is None

    head = HEAD - 1

    assert check(checked, message) is not None


def test_a_forgotten_message_is_accepted_once_more() -> None:
    checked, message = validator(), demand()
    accepted = check(checked, message)
    assert accepted is not None

    checked.forget(accepted)
    checked.forget(accepted)

    assert check(checked, message) == accepted
    assert check(checked, message) is None


def test_a_message_that_is_forgotten_later_is_a_duplicate_until_then() -> None:
    clock = SetClock()
    checked, message = validator(clock=clock), demand()
    accepted, received = check(checked, message), (message_key(MARKET, message), encode(message))
    assert accepted is not None

    checked.forget(accepted, after=5.0)
    clock.pass_by(4 * SECOND)
    assert checked.without_copies([received]) == [None]
    clock.pass_by(SECOND)

    assert checked.without_copies([received]) == [received]
    assert check(checked, message) == accepted
    assert checked.without_copies([received]) == [None]
    assert checked.statistics(received=0, dropped=0).duplicate == 2


def test_the_deduplication_window_is_limited_and_drops_the_oldest() -> None:
    checked, messages = validator(deduplication_limit=2), [demand() for _ in range(3)]
    for message in messages:
        assert check(checked, message) is not None

    assert check(checked, messages[2]) is None
    assert check(checked, messages[0]) is not None


def test_many_threads_accept_each_message_once_and_count_exactly() -> None:
    checked = validator(deduplication_limit=300)
    messages = [demand() for _ in range(200)]
    rejected = offer()

    def check_all() -> list[bytes]:
        accepted = [check(checked, message) for message in messages]
        for _ in range(200):
            check(checked, rejected)
        return [one.hash for one in accepted if one is not None]

    with ThreadPoolExecutor(8) as threads:
        jobs = [threads.submit(check_all) for _ in range(8)]
        accepted = Counter(digest for job in jobs for digest in job.result())

    assert accepted == Counter(message_hash(message) for message in messages)
    statistics = checked.statistics(received=0, dropped=0)
    assert statistics.duplicate == 7 * 200
    assert statistics.invalid == {"kind": 8 * 200}


def test_a_copy_of_an_accepted_message_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    checked, message = validator(), demand()
    assert check(checked, message) is not None
    monkeypatch.setattr(_validation, "decode", None)

    assert check(checked, message) is None
    assert checked.statistics(received=0, dropped=0).duplicate == 1


def test_the_signature_of_a_message_that_comes_twice_at_once_is_verified_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Together, or in one batch but too far apart to be verified together."""
    checked, recovered = validator(), list[SignedDigest]()

    def recover(signed: Iterable[SignedDigest]) -> list[bytes]:
        recovered.extend(together := list(signed))
        return recover_keys(together)

    monkeypatch.setattr(_validation, "recover_keys", recover)
    messages = [demand() for _ in range(_validation.SLICE)]
    copies = [json.dumps(json.loads(encode(messages[place]))).encode() for place in (0, 1)]
    payloads = [encode(messages[0]), copies[0], *map(encode, messages[1:]), copies[1]]

    found = [
        one for some in checked.check_all((message_key(MARKET, messages[0]), one) for one in payloads) for one in some
    ]

    assert [one.message for one in found] == messages
    assert len(recovered) == len(messages)
    assert checked.statistics(received=0, dropped=0).duplicate == 2

    other_bytes = encode(messages[0]).replace(b",", b" ,")
    assert not any(checked.check_all([(message_key(MARKET, messages[0]), other_bytes)]))
    assert len(recovered) == len(messages), "that of a later copy in other bytes isn't verified, either"
    received = message_key(MARKET, messages[0]), payloads[0]
    assert checked.without_copies([received]) == [None], "the first copy is the one that is recognized"


def test_each_copy_of_an_invalid_message_is_counted() -> None:
    checked = validator()
    no_key, upper_half = (
        msgspec.structs.replace(demand(), signature=signature) for signature in ("00" * 64 + "1b", "ff" * 64 + "1b")
    )

    assert not any(checked.check_all([(message_key(MARKET, no_key), encode(no_key))] * 3))
    counts = checked.statistics(received=0, dropped=0)
    assert (counts.invalid, counts.duplicate) == ({"signature": 1}, 2), "copies of it are not recovered"

    assert not any(checked.check_all([(message_key(MARKET, upper_half), encode(upper_half))] * 3))
    counts = checked.statistics(received=0, dropped=0)
    assert (counts.invalid, counts.duplicate) == ({"signature": 4}, 2)

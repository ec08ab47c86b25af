"""Signing and verifying: one signature is valid for a hash and a key, and no other."""

from __future__ import annotations

import json
import pickle
from contextlib import suppress

import msgspec
import pytest
from eth_keys.backends.native.main import NativeECCBackend
from eth_keys.exceptions import BadSignature
from eth_keys.main import KeyAPI
from eth_utils.exceptions import ValidationError
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from schemas import (
    AiraError,
    Demand,
    InputError,
    InvalidMessage,
    InvalidRecord,
    Offer,
    Result,
    SignedMessage,
    Signer,
    encode,
    keccak256,
    message_hash,
    recover,
    verify,
    verify_message,
)
from schemas.address import address_bytes
from schemas.signing import Decline, Rejection, recover_keys, signed_digest, signer_of
from tests.schemas.vectors import VECTORS
from tests.support.schemas.samples import (
    DEMAND,
    DEMAND_5,
    FEEDBACK_JSON,
    LIGHTHOUSE_NAME,
    NONCE,
    OFFER,
    RESULT,
    SENDER,
    TRANSACTION_JSON,
    payload,
)
from tests.support.schemas.strategies import addresses, orders, results, withdrawals

KEY = bytes(31) + b"\7"
SIGNER = Signer(KEY)
DIGEST = keccak256(b"a message")
PURE_PYTHON = KeyAPI(NativeECCBackend())
CURVE_ORDER = 0xFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFEBAAEDCE6AF48A03BBFD25E8CD0364141


def refused(signature: bytes | str) -> InvalidMessage:
    with pytest.raises(InvalidMessage) as caught:
        recover(DIGEST, signature)
    assert caught.value.reason == "signature"
    return caught.value


def test_address_is_that_of_the_key() -> None:
    # The address of the private key 1, known from everywhere.
    assert Signer(bytes(31) + b"\1").address == "0x7E5F4552091A69125d5DfCb7b8C2659029395Bdf"


@given(orders(addresses) | withdrawals(addresses) | results(addresses), st.integers(1, CURVE_ORDER - 1))
def test_a_signed_message_verifies(message: SignedMessage, secret: int) -> None:
    signer = Signer(secret.to_bytes(32, "big"))
    if isinstance(message, Demand | Offer) and message.sender is not None:
        message = msgspec.structs.replace(message, sender=signer.address)
    signed = signer.sign(message)
    verified = verify(encode(signed))
    assert (verified.message, verified.hash, verified.signer) == (signed, message_hash(message), signer.address)
    assert verify_message(signed) == verified


@given(st.binary(min_size=32, max_size=32))
def test_signatures_are_deterministic_with_low_s_and_v_27_or_28(digest: bytes) -> None:
    signature = SIGNER.sign_hash(digest)
    assert signature == SIGNER.sign_hash(digest)
    assert int.from_bytes(signature[32:64], "big") <= CURVE_ORDER // 2
    assert signature[64] in (27, 28)
    assert recover(digest, signature) == recover(digest, "0x" + signature.hex().upper()) == SIGNER.address


def test_any_other_hash_or_signature_gives_another_signer() -> None:
    signature = SIGNER.sign_hash(DIGEST)
    assert recover(keccak256(b"another"), signature) != SIGNER.address
    assert recover(DIGEST, signature[:64] + bytes([55 - signature[64]])) != SIGNER.address


def test_high_s_twin_is_refused() -> None:
    signature = SIGNER.sign_hash(DIGEST)
    s = CURVE_ORDER - int.from_bytes(signature[32:64], "big")
    refused(signature[:32] + s.to_bytes(32, "big") + bytes([55 - signature[64]]))


def test_the_highest_low_s_is_accepted_and_the_next_refused() -> None:
    half = CURVE_ORDER // 2
    r = SIGNER.sign_hash(DIGEST)[:32]
    assert recover(DIGEST, r + half.to_bytes(32, "big") + b"\x1b")
    assert "upper half" in refused(r + (half + 1).to_bytes(32, "big") + b"\x1b").detail


@pytest.mark.parametrize("v", [0, 1, 2, 3, 26, 29, 30, 255])
def test_only_v_27_and_28_are_accepted(v: int) -> None:
    assert f"v is {v}" in refused(SIGNER.sign_hash(DIGEST)[:64] + bytes([v])).detail


def test_signature_that_no_key_could_have_made_is_refused() -> None:
    s = SIGNER.sign_hash(DIGEST)[32:64]
    for r in (bytes(32), CURVE_ORDER.to_bytes(32, "big"), b"\xff" * 32, (5).to_bytes(32, "big")):
        refused(r + s + b"\x1b")
    refused(bytes(64) + b"\x1b")
    refused(SIGNER.sign_hash(DIGEST)[:32] + bytes(32) + b"\x1b")


def test_signature_of_another_length_is_refused() -> None:
    for signature in (b"", bytes(64), bytes(66), "", "0x", "11" * 64, "xyz"):
        refused(signature)


@given(st.binary(min_size=60, max_size=70))
def test_any_bytes_verify_or_raise_invalid_message(signature: bytes) -> None:
    with suppress(InvalidMessage):
        assert recover(DIGEST, signature).startswith("0x")


@given(st.lists(st.tuples(st.binary(min_size=32, max_size=32), st.binary(min_size=64, max_size=64), st.booleans())))
def test_keys_are_recovered_as_by_another_library(signatures: list[tuple[bytes, bytes, bool]]) -> None:
    """Also those between signatures that no key could have made."""
    signed = []
    for digest, compact, is_odd in signatures:
        with suppress(InvalidMessage):
            signed.append(signed_digest(digest, compact + bytes([27 + is_odd])))
    expected = []
    for digest, signature, recovery_id in signed:
        try:
            made = PURE_PYTHON.Signature(signature[:64] + bytes([recovery_id]))
            expected.append(made.recover_public_key_from_msg_hash(digest).to_canonical_address())
        except (BadSignature, ValidationError):
            expected.append(b"")
    assert [address_bytes(signer_of(key)) if key else b"" for key in recover_keys(signed)] == expected


def test_unsigned_message_does_not_verify() -> None:
    with pytest.raises(InvalidMessage) as caught:
        verify_message(msgspec.structs.replace(DEMAND, signature=""))
    assert caught.value.reason == "signature"


@pytest.mark.parametrize("fields", [FEEDBACK_JSON, TRANSACTION_JSON])
def test_feedback_can_not_be_verified(fields: dict[str, object]) -> None:
    with pytest.raises(InvalidMessage) as caught:
        verify(payload(fields))
    assert caught.value.reason == "unsigned"


def test_names_must_be_resolved_before_verifying() -> None:
    named = msgspec.structs.replace(DEMAND, lighthouse=LIGHTHOUSE_NAME)
    with pytest.raises(InvalidMessage) as caught:
        verify(encode(named))
    assert caught.value.reason == "unresolved-name"


def test_generation_5_order_must_be_signed_by_its_sender() -> None:
    mine = msgspec.structs.replace(DEMAND_5, sender=SIGNER.address)
    signature = SIGNER.sign_hash(message_hash(DEMAND_5)).hex()
    assert verify_message(SIGNER.sign(mine)).signer == SIGNER.address
    with pytest.raises(InvalidMessage) as caught:
        verify(encode(msgspec.structs.replace(DEMAND_5, signature=signature)))
    assert caught.value.reason == "sender"


def test_a_signer_does_not_sign_for_another_sender() -> None:
    with pytest.raises(InvalidMessage) as caught:
        SIGNER.sign(DEMAND_5)
    assert caught.value.reason == "sender"


def test_changed_message_has_another_signer() -> None:
    for message in (DEMAND, OFFER, RESULT):
        signed = SIGNER.sign(message)
        changes = {"success": False} if isinstance(message, Result) else {"cost": message.cost + 1}
        assert verify_message(msgspec.structs.replace(signed, **changes)).signer != SIGNER.address


def test_changed_order_of_generation_5_is_refused() -> None:
    signed = SIGNER.sign(msgspec.structs.replace(DEMAND_5, sender=SIGNER.address))
    with pytest.raises(InvalidMessage):
        verify_message(msgspec.structs.replace(signed, cost=signed.cost + 1))


@pytest.mark.parametrize("key", [b"", bytes(32), bytes(31), b"\1" * 33, CURVE_ORDER.to_bytes(32, "big"), b"\xff" * 32])
def test_invalid_private_keys_are_refused(key: bytes) -> None:
    with pytest.raises(InputError) as caught:
        Signer(key)
    assert key.hex() not in str(caught.value) or not key


def test_hash_to_sign_has_32_bytes() -> None:
    with pytest.raises(InputError):
        SIGNER.sign_hash(b"short")


def test_a_signer_does_not_show_its_key() -> None:
    secret = VECTORS[3][0].key
    signer = Signer(secret)
    assert repr(signer) == str(signer) == f"Signer({signer.address})"
    assert not hasattr(signer, "__dict__")
    with pytest.raises((TypeError, AttributeError)):
        pickle.dumps(signer)


def test_signatures_agree_with_another_library() -> None:
    prefixed = keccak256(b"\x19Ethereum Signed Message:\n32" + DIGEST)
    expected = PURE_PYTHON.PrivateKey(KEY).sign_msg_hash(prefixed).to_bytes()
    assert SIGNER.sign_hash(DIGEST) == expected[:64] + bytes([expected[64] + 27])


def test_errors_are_those_of_the_project() -> None:
    with pytest.raises(AiraError):
        verify(b"{}")


def test_rejection_is_read_as_written() -> None:
    rejection = Rejection(order=NONCE, reason="deadline", detail="block 7 has passed", provider=SENDER)
    assert Rejection.decode(rejection.encode()) == rejection
    assert json.loads(rejection.encode()).keys() == {"order", "reason", "detail", "provider", "signature"}


def test_a_signed_rejection_is_signed() -> None:
    signer = Signer(b"\x07" * 32)
    rejection = Rejection(order=NONCE, reason="full", detail="later", provider=signer.address).signed_by(signer)
    assert rejection.is_signed
    assert Rejection.decode(rejection.encode()).is_signed


@pytest.mark.parametrize("field", ["order", "reason", "detail", "provider", "signature"])
def test_a_changed_rejection_is_not_signed(field: str) -> None:
    signer = Signer(b"\x07" * 32)
    rejection = Rejection(order=NONCE, reason="full", detail="later", provider=signer.address).signed_by(signer)
    for other in ("", "0", SENDER, "ab" * 65):
        assert not replace(rejection, **{field: other}).is_signed


def test_a_rejection_signed_by_another_account_is_not_signed() -> None:
    rejection = Rejection(order=NONCE, reason="full", detail="", provider=SENDER)
    assert not rejection.is_signed
    assert not rejection.signed_by(Signer(b"\x07" * 32)).is_signed


DECLINE = {"order": NONCE, "code": "too-cheap", "detail": "costs at least 5 XRT"}


def test_a_signed_decline_is_signed_and_read_as_written() -> None:
    signer = Signer(b"\x07" * 32)
    decline = Decline(**DECLINE, agent=signer.address)
    assert not decline.is_signed
    read = Decline.decode(decline.signed_by(signer).encode())
    assert read.is_signed
    assert replace(read, signature="") == decline
    assert not decline.signed_by(Signer(b"\x08" * 32)).is_signed


@pytest.mark.parametrize(
    ("field", "text"), [("order", "ab" * 32), ("code", "busy"), ("detail", ""), ("agent", SENDER), ("signature", "ab")]
)
def test_a_changed_decline_is_not_signed(field: str, text: str) -> None:
    signer = Signer(b"\x07" * 32)
    decline = Decline(**DECLINE, agent=signer.address).signed_by(signer)
    assert not replace(decline, **{field: text}).is_signed


def test_a_signature_of_a_rejection_is_none_of_a_decline() -> None:
    signer = Signer(b"\x07" * 32)
    rejection = Rejection(order=NONCE, reason="busy", detail="", provider=signer.address).signed_by(signer)
    assert not Decline(
        order=NONCE, code="busy", detail="", agent=signer.address, signature=rejection.signature
    ).is_signed


@pytest.mark.parametrize(
    ("field", "text"),
    [("order", "12"), ("order", NONCE.upper()), ("code", ""), ("code", "Too cheap"), ("code", "a" * 65), 
     ("code", "a\n"), ("code", "a--b"), ("detail", "a" * 501)],
)  # fmt: skip
def test_a_decline_has_bounded_words(field: str, text: str) -> None:
    fields = DECLINE | {"agent": SENDER, field: text}
    with pytest.raises(InvalidRecord):
        Decline(**fields)
    with pytest.raises(InvalidRecord):
        Decline.decode(json.dumps(fields).encode())

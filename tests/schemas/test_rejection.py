"""A provider's word that it can't use a message."""

from __future__ import annotations

import json

import pytest
from msgspec.structs import replace

from schemas import Signer
from schemas.rejection import Rejection
from tests.schemas.samples import NONCE, SENDER


def test_rejection_is_read_as_written() -> None:
    rejection = Rejection(order=NONCE, reason="deadline", detail="block 7 has passed", provider=SENDER)
    assert Rejection.decode(rejection.encode()) == rejection
    assert json.loads(rejection.encode()).keys() == {"order", "reason", "detail", "provider", "signature"}


def test_a_signed_rejection_is_the_providers_word() -> None:
    signer = Signer(b"\x07" * 32)
    rejection = Rejection(order=NONCE, reason="full", detail="later", provider=signer.address).signed_by(signer)
    assert rejection.is_signed
    assert Rejection.decode(rejection.encode()).is_signed


@pytest.mark.parametrize("field", ["order", "reason", "detail", "provider", "signature"])
def test_a_changed_rejection_is_nobodys_word(field: str) -> None:
    signer = Signer(b"\x07" * 32)
    rejection = Rejection(order=NONCE, reason="full", detail="later", provider=signer.address).signed_by(signer)
    for other in ("", "0", SENDER, "ab" * 65):
        assert not replace(rejection, **{field: other}).is_signed


def test_nobody_signs_for_another() -> None:
    rejection = Rejection(order=NONCE, reason="full", detail="", provider=SENDER)
    assert not rejection.is_signed
    assert not rejection.signed_by(Signer(b"\x07" * 32)).is_signed

"""Messages of legacy clients are decoded, hashed, verified, signed and encoded as by those clients."""

from __future__ import annotations

import json

import pytest

from schemas import Demand, Offer, Result, Signer, decode, encode, message_hash, verify
from tests.schemas.vectors import ALL_VECTORS, VECTORS, Vector

KINDS: dict[str, type[Demand | Offer | Result]] = {"demand": Demand, "offer": Offer, "result": Result}

each_vector = pytest.mark.parametrize("vector", ALL_VECTORS, ids=lambda vector: f"{vector.kind}-{vector.hash[2:10]}")


@each_vector
def test_a_legacy_message_decodes_with_its_kind_hash_and_signer(vector: Vector) -> None:
    verified = verify(vector.payload)
    assert isinstance(verified.message, KINDS[vector.kind])
    assert "0x" + verified.hash.hex() == vector.hash
    assert verified.signer == vector.signer


@each_vector
def test_signing_again_gives_the_same_signature(vector: Vector) -> None:
    message = verify(vector.payload).message
    signer = Signer(vector.key)
    assert signer.address == vector.signer
    assert signer.sign(message) == message


@each_vector
def test_encoded_json_decodes_to_the_same_message(vector: Vector) -> None:
    assert json.loads(encode(decode(vector.payload))) == json.loads(vector.wire)


@pytest.mark.parametrize("generation", [3, 5])
def test_generation_is_that_of_the_clients(generation: int) -> None:
    orders = [decode(vector.payload) for vector in VECTORS[generation] if vector.kind != "result"]
    assert len(orders) == 40
    for order in orders:
        assert isinstance(order, Demand | Offer)
        assert order.generation == generation


def test_documented_result_has_the_documented_hash() -> None:
    result = Result(
        liability="0xcC4f10c72908D7b8A0eB7fBa70f00b135b3f97d7",
        result="Qmd32ebrLAsXPFQQK2LDWY6ekcvz1yDC62jGskUFNEDSbA",
        success=True,
    )
    assert message_hash(result).hex() == "55c1a3f47762a8d67ed7c76bc140f85bdbf6eb41e70cc13aa41ed1791d939464"
